"""Ctrl-C that waits until a sweep is done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any


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
