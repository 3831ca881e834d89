"""Exact answers that share no code with the engines."""
