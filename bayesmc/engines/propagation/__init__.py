"""Expectation propagation on nets: what is approximated, by which messages, and what that answers."""
