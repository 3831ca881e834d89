"""Exact answers by elimination: finite nodes as tables, linear-Gaussian ones as mixtures of Gaussians."""
