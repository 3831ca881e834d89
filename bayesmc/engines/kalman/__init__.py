"""Kalman filters: linear-Gaussian templates exactly, others linearised or through sigma points."""
