"""Nets on real numbers, run by ``make demo`` (``python -m examples.demo``)."""
