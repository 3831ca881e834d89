"""Scripts of a page or two, each run by ``python -m examples.NAME``, all by ``make demo``."""
