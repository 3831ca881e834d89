"""Sampled numbers drawn with a look at what is read of elements: FastSLAM 2.0."""

from __future__ import annotations

from typing import Any


class Guide:
    def __init__(self, plan: Any, elements: Any, step: Any, names: tuple[str, ...]) -> None:
        self.waiting: frozenset[str] = frozenset(names)


def why_not_guided(slices, elements, name):
    return "is not"
