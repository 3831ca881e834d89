"""What the house measures: its lines, the way a call takes through it, and the functions it can follow.

``python -m tests.counts`` prints them all, ``python -m tests.counts lines|hops|followed`` one.
"""
