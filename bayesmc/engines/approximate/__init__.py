"""Deterministic approximations of a posterior: what they share, and those by a mode and its curvature."""
