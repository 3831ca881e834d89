"""Tests of whatever moves states, against the joint law that a net declares."""
