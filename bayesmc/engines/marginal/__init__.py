"""Particle filters that integrate out what is linear-Gaussian given the rest: Rao-Blackwellised ones."""
