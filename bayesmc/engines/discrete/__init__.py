"""Exact filters for templates whose hidden nodes are finite."""
