"""Compiled templates on their way to files and other processes: without functions, with what these said."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from bayesmc.network import Model
from bayesmc.network.fingerprint import lasting_fingerprint


class Travelling:
    """Two models that pickles and files carry without their functions."""

    first: Model
    later: Model

    def __getstate__(self) -> dict[str, Any]:
        models = {"first": self.first.without_functions(), "later": self.later.without_functions()}
        return {**self.__dict__, **models, "prints": self.prints}

    @cached_property
    def prints(self) -> dict[str, str]:
        """What both models say, in a form that outlives their functions."""
        return lasting_fingerprint({"in slice 0": self.first, "in later slices": self.later})
