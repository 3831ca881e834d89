"""A helper, not a script: the examples' options, empty axes, and a saved file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# One colour for each role, the same in all figures.
EXACT, DRAWS, OTHER, FAINT = "#1b2a41", "#7fb2e5", "#d1495b", "#9aa5b1"
#: points per inch of saved pictures
DPI = 150


def options(doc: str | None, arguments: Sequence[str] | None) -> argparse.Namespace:
    """``fast`` and ``out``, as every example takes them."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--fast", action="store_true", help="few draws, for a smoke test")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for pictures")
    return parser.parse_args(arguments)


def axes(mosaic: list[list[str]], size: tuple[float, float], **keywords: Any) -> tuple[Any, Any]:
    """A figure and its axes by name, without the frame's upper and right side."""
    with pyplot().rc_context({"axes.spines.top": False, "axes.spines.right": False}):
        return pyplot().subplot_mosaic(mosaic, figsize=size, layout="constrained", **keywords)


def save(figure: Any, folder: Path, name: str) -> None:
    """Write ``name``.png, and say where."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", dpi=DPI)
    pyplot().close(figure)
    print(f"wrote {folder / name}.png")


def pyplot() -> Any:
    """``matplotlib.pyplot``, set to write files and open no window."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    return pyplot
