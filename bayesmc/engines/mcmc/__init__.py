"""Markov chains: options and plans of Gibbs and Metropolis-Hastings, the one loop, starts, convergence."""
