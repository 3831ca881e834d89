"""A helper, not a script: where the published logs, images and tables are, if they are at hand."""

from __future__ import annotations

import os
from pathlib import Path


def folder(*parts: str) -> Path | None:
    """A folder of the data (``BAYESMC_DATA``, else ``../shared/data`` beside the checkout), or None."""
    named = os.environ.get("BAYESMC_DATA")
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    found = (Path(named) if named else beside).joinpath(*parts)
    return found if found.is_dir() else None
