"""What a case is: a model as a user writes it, the figures published for it, and how to ask.

Reference names are those of the publication (``alpha.c``, ``theta[3]``, from 1); ``Case.locate`` turns
one into a node and an index. No engine and no verdict is known here.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import bayesmc as bmc

Index = tuple[int, ...]
Rule = Literal["bugs", "posteriordb"]


@dataclass(frozen=True)
class Question:
    """A net with its evidence and inputs, ready for ``bmc.infer``."""

    net: bmc.BayesNet
    evidence: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, Any] | None = None

    def infer(self, engine: Any, **options: Any) -> bmc.Posterior:
        """The posterior by ``engine``; ``options`` go to ``bmc.infer``."""
        return bmc.infer(self.net, self.evidence, inputs=self.inputs, engine=engine, **options)


@dataclass(frozen=True)
class Figures:
    """What is published for one scalar.

    Attributes
    ----------
    mean, sd : float
        Posterior mean and standard deviation.
    mcse : float
        Monte Carlo standard error of ``mean``; 0 where exact, NaN where none is given.
    cdf : callable, optional
        Exact posterior cdf: given for parameters whose moments are too heavy-tailed to compare.
    """

    mean: float
    sd: float
    mcse: float = float("nan")
    cdf: Callable[[Any], Any] | None = None


def none() -> None:
    """The engine of every case, unless it says otherwise: what a user gets who names none."""
    return None


@dataclass(frozen=True)
class Case:
    """One model with its data, what is published for it, and the rule it is held to.

    Attributes
    ----------
    model, test : str
        ``"rats"`` and ``"test1"``; the test is empty where a model has only one.
    files : mapping
        Key -> path of a JSON file, from the data folder.
    build : callable
        Key -> parsed file -> ``Question``.
    publish : callable
        Key -> parsed file -> reference name -> ``Figures``.
    rule : {"bugs", "posteriordb"}
        How far is too far; see ``references.verdict``.
    monitors : mapping
        Exceptions from ``locate``'s own reading: a reference name, with or without its index, -> the
        node's name, or the node's name and an index from 0.
    engine : callable
        Makes the engine; None for what ``bmc.infer`` takes by itself.
    """

    model: str
    test: str
    files: Mapping[str, str]
    build: Callable[[Any], Question]
    publish: Callable[[Any], Mapping[str, Figures]]
    rule: Rule
    monitors: Mapping[str, str | tuple[str, Index]] = field(default_factory=dict)
    engine: Callable[[], Any] = none

    @property
    def name(self) -> str:
        """Model and test, as in ``"rats test1"``."""
        return f"{self.model} {self.test}".rstrip()

    def read(self, root: Path) -> dict[str, Any]:
        """The parsed files."""
        return {
            key: json.loads((root / path).read_text(encoding="utf-8"))
            for key, path in self.files.items()
        }

    def question(self, root: Path) -> Question:
        """The net, its evidence and inputs, from the data folder ``root``."""
        return self.build(self.read(root))

    def published(self, root: Path) -> Mapping[str, Figures]:
        """The figures published, by reference name."""
        return self.publish(self.read(root))

    def locate(self, reference: str) -> tuple[str, Index]:
        """Node and index (from 0) of a reference name.

        ``"r.hat[3]"`` is ``("r_hat", (2,))`` unless ``monitors`` says otherwise.
        """
        base, index = split(reference)
        target = self.monitors.get(reference, self.monitors.get(base, base.replace(".", "_")))
        return (target, index) if isinstance(target, str) else target


def data_folder() -> Path:
    """Where the reference data lies: ``BAYESMC_DATA``, else ``../shared/data``."""
    named = os.environ.get("BAYESMC_DATA")
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(named) if named else beside


def split(reference: str) -> tuple[str, Index]:
    """Name and index (from 0) of a reference name."""
    match = re.fullmatch(r"([^\[\]]+)(?:\[([\d,]+)\])?", reference)
    if match is None:
        raise ValueError(f"reference name {reference!r}: expected a name or name[i,j] from 1")
    base, index = match.groups()
    return base, tuple(int(i) - 1 for i in index.split(",")) if index else ()
