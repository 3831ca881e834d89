"""The pages of the API, a room each, written from what the package offers: no name is forgotten."""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bayesmc as bmc
from bayesmc.engines.base import Engine
from bayesmc.engines.filtering import FilterEngine

#: rooms with a page of their own
MODULES = ("io", "markov", "montecarlo", "plotting", "robotics", "sklearn", "testing", "vision")
TITLES = {
    "models": "Models: nets, templates, factor graphs",
    "asking": "Asking: infer, filter, smooth, explain",
    "distributions": "Distributions",
    "engines": "Engines for nets",
    "filters": "Engines over time",
    "answers": "Answers",
    "errors": "Errors and warnings",
    "io": "Files in and out",
    "markov": "Finite Markov chains",
    "montecarlo": "Monte Carlo without nets",
    "plotting": "Pictures",
    "robotics": "Robots",
    "sklearn": "scikit-learn",
    "testing": "Testing samplers",
    "vision": "Vision",
}
MODELS = ("BayesNet", "DynamicBayesNet", "FactorGraph", "PlateArray", "stack")


def write_pages(folder: Path) -> None:
    """One reStructuredText page for each room, and their index, in an emptied folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rooms = _rooms()
    for room, names in rooms.items():
        module = "bayesmc" if room not in (*MODULES, "errors") else f"bayesmc.{room}"
        (folder / f"{room}.rst").write_text(_page(TITLES[room], module, names), "utf-8")
    listed = "\n   ".join(rooms)
    (folder / "index.rst").write_text(
        f"API\n===\n\nEvery public name, by rooms.\n\n.. toctree::\n   :maxdepth: 1\n\n   {listed}\n",
        "utf-8",
    )


def escape_stars(
    app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Stars that open no emphasis, as in ``(*batch, n)``: docstrings are written to be read as they are."""
    for k, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)
        parts[::2] = [
            re.sub(r"(?<![*\\\w])(\*{1,2})(?=\w)(?![^*]*\w\*)", r"\\\1", p) for p in parts[::2]
        ]
        lines[k] = "".join(parts)


def _rooms() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {room: [] for room in TITLES}
    for name in bmc.__all__:
        if not inspect.ismodule(value := getattr(bmc, name)):
            found[_room(name, value)].append(name)
    found["errors"] = [n for n, v in vars(bmc.errors).items() if _is_error(v)]
    for module in MODULES:
        try:
            found[module] = list(importlib.import_module(f"bayesmc.{module}").__all__)
        except ModuleNotFoundError:
            continue
    return {room: names for room, names in found.items() if names}


def _room(name: str, value: Any) -> str:
    if name in MODELS:
        return "models"
    if not inspect.isclass(value):
        return "asking"
    if issubclass(value, bmc.Distribution):
        return "distributions"
    if issubclass(value, FilterEngine):
        return "filters"
    return "engines" if issubclass(value, Engine) or "engines" in value.__module__ else "answers"


def _is_error(value: Any) -> bool:
    return inspect.isclass(value) and value.__module__ == bmc.errors.__name__


def _page(title: str, module: str, names: Iterable[str]) -> str:
    listed = "\n   ".join(sorted(names, key=str.lower))
    return (
        f"{title}\n{'=' * len(title)}\n\n.. currentmodule:: {module}\n\n"
        f".. autosummary::\n   :toctree: generated\n   :nosignatures:\n\n   {listed}\n"
    )
