"""Variational inference: the best approximation among distributions in which nodes are independent."""
