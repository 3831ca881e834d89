"""Switching Kalman filters: finite modes, and states that are linear-Gaussian given them."""
