"""A progress bar for what takes more than a second (tqdm is imported only then); Ctrl-C that waits."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any


class Progress:
    """Counts work done and shows it once a second has passed.

    Parameters
    ----------
    total : int or None
        Units of work; None where nobody knows.
    label : str
    show : bool or None
        True: always; False: never; None: where the error stream is a terminal.
    """

    def __init__(self, total: int | None, label: str, show: bool | None = None) -> None:
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

    def tell(self, label: str) -> None:
        """Say something else in front of the bar from now on."""
        self.label = label
        if self._bar is not None:
            self._bar.set_description(label, refresh=False)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._bar is not None:
            self._bar.close()


class Patience(AbstractContextManager["Patience"]):
    """Within it, Ctrl-C waits until it is asked for, so that it cannot cut a sweep; a second one does not.

    Only Python's own handling is put off, which a program that handles the signal itself has replaced.
    """

    def __init__(self) -> None:
        self._pressed = False
        self._own: Callable[..., Any] | None = None

    def check(self) -> None:
        """Raise what was put off."""
        if self._pressed:
            raise KeyboardInterrupt

    def __enter__(self) -> Patience:
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._own = signal.default_int_handler
            signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *exc: object) -> None:
        if self._own is not None:
            signal.signal(signal.SIGINT, self._own)

    def _note(self, number: int, frame: Any) -> None:
        if self._pressed:
            raise KeyboardInterrupt
        self._pressed = True
