"""Kalman filters: linear-Gaussian templates exactly, others made linear or through sigma points."""
