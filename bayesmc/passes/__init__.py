"""Passes over the expression graph: what engines want to know of a density, one short module each."""
