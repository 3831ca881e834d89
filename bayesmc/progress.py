"""A progress bar for what takes more than a second; tqdm is imported only then."""

from __future__ import annotations

import sys
import time
from typing import Any


class Progress:
    """Counts work done and shows it once a second has passed.

    Parameters
    ----------
    total : int
        Units of work.
    label : str
    show : bool or None
        True: always; False: never; None: where the error stream is a terminal.
    """

    def __init__(self, total: int, label: str, show: bool | None = None) -> None:
        self.total = total
        self.label = label
        self.done = 0
        self._shown = sys.stderr.isatty() if show is None else bool(show)
        self._start = time.monotonic()
        self._bar: Any = None

    def advance(self, units: int = 1) -> None:
        """Note that ``units`` more are done."""
        self.done += units
        if not self._shown:
            return
        if self._bar is None and time.monotonic() - self._start > 1.0:
            from tqdm import tqdm

            self._bar = tqdm(total=self.total, initial=self.done, desc=self.label, leave=False)
        elif self._bar is not None:
            self._bar.update(units)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._bar is not None:
            self._bar.close()
