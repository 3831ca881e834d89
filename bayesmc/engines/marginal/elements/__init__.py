"""Plates of Gaussians of which a slice reads picked elements: a small Kalman filter for each element."""
