"""``load``, and the files of runs: whether one belongs to the call that is made, and what is in it."""

from __future__ import annotations

import importlib.util
import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from bayesmc.dbn import DynamicBayesNet, SeriesProblem
from bayesmc.engines.unrolled import pose_any
from bayesmc.errors import (
    CheckpointError,
    EvidenceError,
    FileFormatError,
    ModelError,
    UnsupportedError,
)
from bayesmc.network import BayesNet, FactorGraph, Problem
from bayesmc.network.digest import digest
from bayesmc.network.fingerprint import Fingerprint, evidence_fingerprint, fingerprint
from bayesmc.randomness import seed_sequence
from bayesmc.results import Posterior, RunFile
from bayesmc.results.many import Posteriors
from bayesmc.results.run_files import answer_in, difference, header_in, made, remove_units
from bayesmc.results.saving import ANSWER, RUN
from bayesmc.states import StateArray
from bayesmc.storage import CheckpointFile, open_image, unpacked
from bayesmc.storage.image import Stored, libraries

#: what can be told of a value in a message
_SHOWN = 60


def load(
    path: str | os.PathLike[str], net: BayesNet | FactorGraph | DynamicBayesNet | None = None
) -> Any:
    """What ``posterior.save(path)`` or ``checkpoint=path`` wrote: a posterior, one over time, or a belief.

    Nothing in a file is run. Functions are not in it: what needs none is answered at once (means, quantiles,
    tables, expectations over draws, ...); the rest (``predict``, going on with ``resume=``) needs the net.

    Parameters
    ----------
    path : path
    net : BayesNet, FactorGraph or DynamicBayesNet, optional
        The net that the question was about, declared again; it is compared with the one of the file. A belief
        goes on with ``engine.start(dbn, belief=bmc.load(path))``.

    Returns
    -------
    Posterior, SeriesPosterior or belief
        Of a run that has not ended, what it has come to so far.

    Raises
    ------
    FileNotFoundError, MissingExtraError
    DamagedFileError
        The file is cut off.
    FileFormatError
        It is none of ours, or of another version.
    CheckpointError
        The net is another one; the message says where.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> bmc.infer(net, {"y": 1.0}).save("exact.nc")  # doctest: +SKIP
    >>> bmc.load("exact.nc").mean("x")  # doctest: +SKIP
    0.5
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(
            f"{path}: that is a folder; of several series each has a file in it: bmc.load(folder / "
            '"series0.nc")'
        )
    image = open_image(path)
    kind = image.attributes.get("kind")
    if kind == RUN:
        answer, header = _so_far(path)
    elif kind == ANSWER:
        found = unpacked(image.packed, Stored(path))
        answer, header = found["answer"], found["header"] or {}
    else:
        raise FileFormatError(f"{path}: bayesmc does not know what a {kind!r} is")
    return answer if net is None else _with_net(path, answer, header, net)


class Opened:
    """The file of a run, as a call finds it.

    Parameters
    ----------
    call : str
        ``"infer"``, ``"infer_many"``, ``"filter"`` or ``"smooth"``.
    checkpoint : path or CheckpointFile
    problem : Problem or SeriesProblem
    named : bool
        Whether the call names its engine, which then is that of all questions asked with it.
    """

    def __init__(
        self, call: str, checkpoint: Any, problem: Problem | SeriesProblem, named: bool = False
    ) -> None:
        self.call, self.problem, self.named = call, problem, named
        self.file = CheckpointFile.of(checkpoint)
        self.path = Path(self.file.path)
        libraries()
        if self.path.is_dir():
            raise CheckpointError(
                f"{call}(checkpoint={str(self.path)!r}): that is a folder; give the path of a file, such as "
                f"{str(self.path / 'run.nc')!r}"
            )
        self.header: Mapping[str, Any] | None = None
        self.image = None
        if self.path.exists():
            self.image = open_image(self.path)
            self.header = header_in(self.image)
            if "identity" not in self.header:
                raise CheckpointError(
                    f"{call}(checkpoint={str(self.path)!r}): the file holds an answer that was saved, and "
                    "no run; give another path (bmc.load reads it)"
                )
            if "call" in self.header and self.header["call"] != call:
                raise CheckpointError(
                    f"{call}(checkpoint={str(self.path)!r}): the file belongs to a call of "
                    f"{self.header['call']}; give another path"
                )

    @property
    def engine(self) -> Any:
        """The engine of the run; None where none has begun."""
        return None if self.header is None else self.header["engine"]

    def seed(self, rng: Any) -> np.random.SeedSequence:
        """The run's own, where the call gives none."""
        if rng is None and self.header is not None:
            found: np.random.SeedSequence = self.header["seed"]
            return found
        return seed_sequence(rng)

    def begin(
        self, engine: Any, seed: np.random.SeedSequence, keep: Any, more: Mapping[str, Any]
    ) -> Begun:
        """The file of the run, made or gone on with, or its answer.

        Parameters
        ----------
        more : dict
            Other arguments of the call, by name.

        Raises
        ------
        CheckpointError
            The file is of another run; the message says what differs.
        """
        identity = _identity(self.problem, engine, seed, {"keep": keep, **more})
        if self.header is not None and engine is self.header["engine"]:
            own = f"{type(engine).__name__}("  # options that are the file's own, whatever they came back as
            was = self.header["identity"]
            identity |= {what: told for what, told in was.items() if what.startswith(own)}
        header: Mapping[str, Any] = self.header or {
            "identity": identity, "engine": engine, "seed": seed, "keep": keep, "named": self.named,
            "call": self.call,
        }  # fmt: skip
        if self.header is None:
            made(self.path, self.problem, header)
            self.image = open_image(self.path)
            was = header_in(self.image)["identity"]  # another process may have come first
        else:
            was = header["identity"]
        if why := difference(was, identity):
            raise CheckpointError(
                f"{self.call}(checkpoint={str(self.path)!r}): the file belongs to another run: {why}; "
                "make the same call to go on with it, or give another path"
            )
        if self.image is not None and self.image.attributes["kind"] == ANSWER:
            remove_units(self.path, identity)  # where the process ended before it could
            spilled = keep == "file" or isinstance(keep, Mapping)
            with suppress(UnsupportedError):  # of an approximation, which is made again
                return Begun(None, answer_in(self.path, self.image, self.problem, spilled))
        run = RunFile(self.file, header)
        ended = run.blocks.image.attributes["kind"] == ANSWER
        if ended and (self.image is None or self.image.attributes["kind"] != ANSWER):
            raise CheckpointError(
                f"{self.call}(checkpoint={str(self.path)!r}): another process has just ended this run; make "
                "the same call for its answer"
            )
        return Begun(run, None)


class Begun(NamedTuple):
    """The file of a run that goes on, or the answer of one that has ended."""

    file: RunFile | None
    answer: Any


# ---- private ------------------------------------------------------------------------------------


def _identity(
    problem: Any, engine: Any, seed: np.random.SeedSequence, more: Mapping[str, Any]
) -> Fingerprint:
    """What a run is: two that agree in it end with the same bits."""
    name = type(engine).__name__
    found: Fingerprint = {"the engine": f"={name}"}
    options = [f.name for f in fields(engine)] if is_dataclass(engine) else sorted(vars(engine))
    found |= {f"{name}({o}=)": _shown(getattr(engine, o)) for o in options}
    if isinstance(problem, SeriesProblem):
        series = problem.series
        found |= {f"slice 0: {k}": v for k, v in fingerprint(problem.slices.first).items()}
        found |= {f"later slices: {k}": v for k, v in fingerprint(problem.slices.later).items()}
        found["the number of rows"] = f"={series.steps}"
        found |= evidence_fingerprint(series.observed, "observations")
        found |= evidence_fingerprint(series.static)
        inputs = series.inputs
    else:
        found |= fingerprint(problem.model)
        found |= evidence_fingerprint(problem.observed)
        inputs = problem.inputs
    found |= {f"the input {n!r}": digest(v) for n, v in inputs.items()}
    key = f"={seed.entropy}" + (f", {seed.spawn_key}" if seed.spawn_key else "")
    found["the seed (rng=)"] = key
    found |= {f"{n}=": _shown(v) for n, v in more.items()}
    fast = importlib.util.find_spec("llvmlite") is not None
    versions = {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "Python": platform.python_version(),
    }
    found |= {f"the version of {n}": f"={v}" for n, v in versions.items()}
    found["machine code (the extra fast)"] = "=there" if fast else "=not there"
    return found


def _shown(value: Any) -> str:
    value = dict(value) if isinstance(value, Mapping) else value  # files know no other mappings
    simple = value is None or isinstance(value, (bool, int, float, str))
    plain = simple or (isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value))
    text = repr(list(value) if isinstance(value, tuple) else value) if plain else ""
    return f"={text}" if plain and len(text) <= _SHOWN else digest(value)


def _so_far(path: Any) -> tuple[Any, Mapping[str, Any]]:
    """What a run has come to that has not ended."""
    header = unpacked(open_image(path).packed)["header"]
    run = RunFile(CheckpointFile(path), header, alone=False)
    engine = header["engine"]
    answer = None
    if hasattr(engine, "so_far") and "model" in header:
        problem = Problem(None, header["model"], header["observed"], header["inputs"])  # type: ignore[arg-type]
        answer = engine.so_far(problem, run)
    if answer is None:
        raise UnsupportedError(
            f"{path}: the run has not ended, and has no answer yet; make the same call again to go on with it"
        )
    answer.problem = None
    return answer, header


def _with_net(path: Any, answer: Any, header: Mapping[str, Any], net: Any) -> Any:
    """A posterior, or several, with the functions of its net."""
    if not isinstance(answer, (Posterior, Posteriors)):
        raise ModelError(
            f"load(net=): a {type(answer).__name__} answers without a net; a belief goes on with "
            "engine.start(dbn, belief=bmc.load(path))"
        )
    if isinstance(net, DynamicBayesNet):
        raise ModelError(
            "load(net=): the answer is about an unrolled net; give net=dbn.unroll(steps), with its inputs"
        )
    if isinstance(answer, Posterior):
        was = header.get("fingerprint", header.get("identity", {}))
        answer.bind(_problem_of(path, answer, was, net))
        return answer
    prints, whose = header.get("fingerprints", []), iter(header.get("whose", []))
    problems: list[Problem | None] = []
    for one in answer.kept():
        at = None if one is None else next(whose, None)
        problems.append(None if at is None else _problem_of(path, one, prints[at], net))
    answer.bind(problems)
    return answer


def _problem_of(path: Any, answer: Any, was: Fingerprint, net: Any) -> Problem:
    """The question that an answer is about, asked of a net, which must be the same."""
    inputs = dict(getattr(answer, "_known", {}))
    evidence = {n: _given(answer.model[n], o) for n, o in answer._seen.items()}
    try:
        problem = pose_any(net, evidence, inputs or None)
    except EvidenceError as error:
        raise CheckpointError(
            f"load({str(path)!r}, net=...): the answer is about another net: {error}"
        ) from error
    now = fingerprint(problem.model)
    if why := difference({k: v for k, v in was.items() if k in now}, now) if was else None:
        raise CheckpointError(
            f"load({str(path)!r}, net=...): the answer is about another net: {why}"
        )
    return problem


def _given(node: Any, seen: Any) -> Any:
    """Evidence as the user gave it."""
    values = node.decode(seen.value)
    hidden = None
    if seen.mask is not None:
        hidden = np.broadcast_to(
            ~seen.mask.reshape(seen.mask.shape + (1,) * len(node.event_shape)), node.value_shape
        )
        if seen.parts is not None:
            hidden = hidden & ~seen.parts
    if isinstance(values, StateArray):
        labels = np.array(values.labels, dtype=object)
        if hidden is not None:
            labels[hidden] = None
        return labels if labels.ndim else labels.item()
    return values if hidden is None else np.ma.masked_array(values, hidden)
