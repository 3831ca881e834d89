"""Faults planted in the library, each of which a test of ``bayesmc.testing`` must catch.

``python -m tests.mutants`` tries all of them at fresh seeds and prints a table; ``tests/test_mutants.py``
takes one fixed seed each.
"""
