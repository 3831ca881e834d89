"""Conjugate kernels with deliberate errors in their natural parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bayesmc.kernels.conjugate import Conjugate

#: natural parameters of a full conditional, changed
Change = Callable[..., tuple[Any, ...]]


class WrongForm:
    """A full conditional whose natural parameters are changed."""

    def __init__(self, form: Any, change: Change) -> None:
        self.form, self.change = form, change
        self.family, self.words = form.family, form.words

    def __call__(self, values: Any) -> Any:
        naturals, bounds = self.form(values)
        return self.change(*naturals), bounds

    def left(self, values: Any) -> Any:
        return self.form.left(values)

    def drawn(self, values: Any, rng: Any, chains: int) -> None:
        return None


def with_naturals(kernel: Conjugate, change: Change) -> Conjugate:
    """The same kernel with changed natural parameters."""
    found = Conjugate(kernel.blanket, kernel.forms, kernel.debug)
    found.forms = tuple(WrongForm(f, change) for f in kernel.forms)  # type: ignore[assignment]
    return found
