"""Tests of posteriors, of whole engines, and of estimates, each against what is exact."""
