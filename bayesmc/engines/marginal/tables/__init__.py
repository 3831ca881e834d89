"""Finite nodes that particles integrate out: a table for each particle, or for each element of a plate."""
