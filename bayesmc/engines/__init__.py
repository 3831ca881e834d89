"""Engines: one file per family, each a frozen dataclass of options with ``refusal`` and ``run``."""
