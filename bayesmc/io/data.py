"""Data files of other programs, as arrays: R dumps (JAGS, BUGS, Stan) and Stan's JSON."""

from __future__ import annotations

import json
from os import PathLike
from typing import Any

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.io.content import read_text
from bayesmc.io.rdump import parse_rdump

_WORDS = {"NaN": np.nan, "Inf": np.inf, "+Inf": np.inf, "-Inf": -np.inf,
          "Infinity": np.inf, "+Infinity": np.inf, "-Infinity": -np.inf, None: np.nan}  # fmt: skip


def read_data(path: str | PathLike[str]) -> dict[str, np.ndarray]:
    """The numbers of a data file: Stan's JSON (``.json``), else R's dump or the ``list(...)`` of BUGS.

    Either may be compressed (``.gz``). Missing numbers (``NA``, ``null``) are NaN, as evidence has them;
    whole numbers are integers. Arrays come as the program meant them: ``structure(c(...), .Dim=)`` by
    columns, ``list(y = structure(.Data=c(...), .Dim=))`` of WinBUGS by rows. Indices count from 1 in these
    programs and from 0 here: labels such as ``group``, and the codes of R's factors, are handed over as they
    are (``group - 1`` is the position here). Lists within the data, and data frames, are refused. Of what
    people write by hand ``rep``, ``seq``, ``matrix``, ``array`` and names given before are read.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    dict of str to ndarray

    Raises
    ------
    FileFormatError
        With file and line, where the text is not of the format.
    OSError
        If the file cannot be opened.

    References
    ----------
    CmdStan User's Guide, "JSON Format for CmdStan"; OpenBUGS User Manual, "Formatting of Data".

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import bayesmc as bmc
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "schools.data.R"
    >>> _ = path.write_text("J <- 3\\ny <- c(28, 8, NA)\\nsigma <- c(15, 10, 16.5)")
    >>> data = bmc.io.read_data(path)
    >>> int(data["J"]), data["y"]
    (3, array([28.,  8., nan]))
    """
    text = read_text(path)
    name = str(path).lower().removesuffix(".gz")
    return _of_json(text, path) if name.endswith(".json") else parse_rdump(text, path)


# ---- private ------------------------------------------------------------------------------------


def _of_json(text: str, path: Any) -> dict[str, np.ndarray]:
    try:
        read = json.loads(text)
    except json.JSONDecodeError as error:
        raise FileFormatError(f"not JSON: {error.msg}", path, error.lineno) from error
    if not isinstance(read, dict):
        raise FileFormatError("the JSON holds no names: an object {...} is wanted", path)
    return {name: _array(name, value, path) for name, value in read.items()}


def _array(name: str, value: Any, path: Any) -> np.ndarray:
    try:
        found = np.asarray(_numbers(value))
    except (TypeError, KeyError):
        raise FileFormatError(f"{name!r} holds something that is no number", path) from None
    except ValueError:  # rows of unequal length
        raise FileFormatError(f"the rows of {name!r} differ in length", path) from None
    return found


def _numbers(value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers(part) for part in value]
    if isinstance(value, (bool, int, float)):
        return value
    return _WORDS[value]
