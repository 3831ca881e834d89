"""Tracing may say "a power", "a copy", "a whole event" only of what is: random programs over NumPy.

A program is a list of steps over a pool of values. It is traced once, with the values that other parents
happen to have; what is claimed must then hold of the numbers for other values of them, at sizes from
1e-6 to 1e6.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from bayesmc.testing import session
from bayesmc.tracing import Tracer, axes, claims
from tests.restarted import Restarted

SHAPES = {"x": (2, 3), "z": (3,)}  # x is a vector in a plate, z three scalars
EVENTS = {"x": 1, "z": 0}
SIZES = (1e-6, 1e-3, 1.0, 1e3, 1e6)
FACTORS = (1.7, 1e-2, 300.0)
#: relative error that rounding may explain
TOLERANCE = 1e-8

Step = tuple[str, int]
Program = Sequence[Step]
Operation = Callable[[list[Any], np.random.Generator, np.random.Generator], Any]


def some(pool: list[Any], rng: np.random.Generator) -> Any:
    """A value of the pool, most likely the last."""
    return pool[-1] if rng.random() < 0.7 else pool[rng.integers(len(pool))]


def factor(value: Any, rng: np.random.Generator, other: np.random.Generator) -> Any:
    """Numbers, not zero, that broadcast with a value; now and then a scalar, or one for each event."""
    shape = value.shape[rng.integers(value.ndim + 1) :]
    array = other.choice([-2.0, -0.5, 0.5, 1.0, 3.0], size=shape)
    return array[..., :1] if array.ndim and rng.random() < 0.4 else array


def axis(value: Any, rng: np.random.Generator) -> int:
    return int(rng.integers(-value.ndim, value.ndim))


def places(value: Any, along: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, value.shape[along], size=2)


def exponent(rng: np.random.Generator) -> Any:
    return [2, 3, -1, -2, 0.5, -0.5, 1, 1.5, 0][rng.integers(9)]


#: pool, generator of what the program says, generator of what other parents are; results are often powers
GENTLE: dict[str, Operation] = {
    "scale": lambda p, r, o: (v := some(p, r)) * factor(v, r, o),
    "scale from the left": lambda p, r, o: (lambda v: factor(v, r, o) * v)(some(p, r)),
    "scale by a number": lambda p, r, o: some(p, r) * 2.5,
    "divide": lambda p, r, o: (v := some(p, r)) / factor(v, r, o),
    "divide a number": lambda p, r, o: 3.0 / some(p, r),
    "divide by it": lambda p, r, o: (lambda v: factor(v, r, o) / v)(some(p, r)),
    "negative": lambda p, r, o: -some(p, r),
    "positive": lambda p, r, o: +some(p, r),
    "square": lambda p, r, o: np.square(some(p, r)),
    "root": lambda p, r, o: np.sqrt(some(p, r)),
    "cube root": lambda p, r, o: np.cbrt(some(p, r)),
    "reciprocal": lambda p, r, o: np.reciprocal(some(p, r)),
    "power": lambda p, r, o: some(p, r) ** exponent(r),
    "float power": lambda p, r, o: np.float_power(some(p, r), exponent(r)),
    "product with itself": lambda p, r, o: (v := some(p, r)) * v,
    "product of powers": lambda p, r, o: (v := some(p, r)) * 2.0 * np.sqrt(v),
    "quotient of powers": lambda p, r, o: (v := some(p, r)) ** 3 / v,
    "product of one component": lambda p, r, o: (v := some(p, r))[..., 0] * v[..., 0],
    "index": lambda p, r, o: (v := some(p, r))[..., int(r.integers(v.shape[-1]))],
    "first": lambda p, r, o: some(p, r)[0],
    "slice": lambda p, r, o: some(p, r)[..., ::-1],
    "first axis reversed": lambda p, r, o: some(p, r)[::-1],
    "mask": lambda p, r, o: (v := some(p, r))[..., r.random(v.shape[-1]) < 0.7],
    "new axis": lambda p, r, o: some(p, r)[..., None],
    "new axis before the event": lambda p, r, o: some(p, r)[..., None, :],
    "new axis in front": lambda p, r, o: some(p, r)[None],
    "fancy": lambda p, r, o: (v := some(p, r))[places(v, 0, o)],
    "fancy at the end": lambda p, r, o: (v := some(p, r))[..., places(v, -1, o)],
    "fancy on both": lambda p, r, o: (v := some(p, r))[places(v, 0, o), ..., places(v, -1, o)],
    "take": lambda p, r, o: np.take(v := some(p, r), places(v, k := axis(v, r), o), axis=k),
    "take method": lambda p, r, o: (v := some(p, r)).take(places(v, 0, o), axis=0),
    "reshape": lambda p, r, o: (v := some(p, r)).reshape((*v.shape[:-1], 1, v.shape[-1])),
    "flat": lambda p, r, o: some(p, r).reshape(-1),
    "in Fortran's order": lambda p, r, o: np.reshape(v := some(p, r), v.shape[::-1], order="F"),
    "transpose": lambda p, r, o: some(p, r).T,
    "moveaxis": lambda p, r, o: np.moveaxis(v := some(p, r), axis(v, r), axis(v, r)),
    "swapaxes": lambda p, r, o: np.swapaxes(v := some(p, r), axis(v, r), axis(v, r)),
    "expand": lambda p, r, o: np.expand_dims(v := some(p, r), axis(v, r)),
    "squeeze": lambda p, r, o: np.squeeze(some(p, r)),
    "broadcast": lambda p, r, o: np.broadcast_to(v := some(p, r), (2, *v.shape)),
    "broadcast one": lambda p, r, o: np.broadcast_to((v := some(p, r))[..., :1], v.shape),
    "broadcast arrays": lambda p, r, o: np.broadcast_arrays(v := some(p, r), np.ones(v.shape))[0],
    "copy": lambda p, r, o: np.copy(some(p, r)),
    "astype": lambda p, r, o: some(p, r).astype(float),
    "flip": lambda p, r, o: np.flip(v := some(p, r), axis(v, r)),
    "roll": lambda p, r, o: np.roll(v := some(p, r), 1, axis(v, r)),
    "repeat": lambda p, r, o: np.repeat(v := some(p, r), 2, axis=axis(v, r)),
    "stack": lambda p, r, o: np.stack([v := some(p, r), v], axis=axis(v, r)),
    "stack of one": lambda p, r, o: np.stack(some(p, r)),
    "concatenate": lambda p, r, o: np.concatenate([v := some(p, r), v], axis=axis(v, r)),
    "concatenate one": lambda p, r, o: np.concatenate(some(p, r)),
    "split": lambda p, r, o: np.split(some(p, r), 1, axis=-1)[0],
    "where": lambda p, r, o: np.where(o.random((v := some(p, r)).shape) < 0.5, v, v[..., ::-1]),
    "where in a plate": lambda p, r, o: np.where(
        o.random((*(v := some(p, r)).shape[:-1], 1)) < 0.5, v, np.flip(v, 0)
    ),
    "where of two": lambda p, r, o: np.where(o.random(3) < 0.5, some(p, r), some(p, r)),
    "select": lambda p, r, o: np.select(
        [o.random((v := some(p, r)).shape) < 0.5], [v], v[..., ::-1]
    ),
}
#: results are seldom powers or copies, and traps
HARSH: dict[str, Operation] = {
    "shift": lambda p, r, o: some(p, r) + 1.0,
    "sum of two": lambda p, r, o: (v := some(p, r)) + v[..., ::-1],
    "product of two components": lambda p, r, o: (v := some(p, r))[..., 0] * v[..., -1],
    "product of columns": lambda p, r, o: (v := some(p, r))[..., :1] * v[..., 1:],
    "product with the reverse": lambda p, r, o: (v := some(p, r)) * np.flip(v, -1),
    "product of roots": lambda p, r, o: np.sqrt(v := some(p, r)) * np.sqrt(v[..., ::-1]),
    "product of fancy": lambda p, r, o: (
        (v := some(p, r))[..., places(v, -1, o)] * v[..., places(v, -1, o)]
    ),
    "product of takes": lambda p, r, o: (
        np.take(v := some(p, r), places(v, 0, o), 0) * np.take(v, places(v, 0, o), 0)
    ),
    "product of two sources": lambda p, r, o: some(p, r) * some(p, r),
    "product with a transpose": lambda p, r, o: (v := some(p, r))[..., None] * v[..., None, :],
    "quotient with itself": lambda p, r, o: (v := some(p, r)) / v * 2.0,
    "quotient with the reverse": lambda p, r, o: (v := some(p, r)) / v[::-1],
    "product with a list": lambda p, r, o: (v := some(p, r).reshape(-1)) * [v[0], *v.shape[1:]],
    "power zero": lambda p, r, o: some(p, r) ** 0,
    "power of a parent": lambda p, r, o: some(p, r) ** np.float64(o.integers(1, 4)),
    "power of an array": lambda p, r, o: some(p, r) ** o.integers(1, 3, size=3),
    "power of a 0-d array": lambda p, r, o: some(p, r) ** np.array(o.choice([1.0, 2.0])),
    "power of itself": lambda p, r, o: (v := some(p, r)) ** np.minimum(v, 1.0),
    "base": lambda p, r, o: 2.0 ** np.minimum(some(p, r), 1.0),
    "outer": lambda p, r, o: np.multiply.outer(v := some(p, r), v.reshape(-1)[:2]),
    "where of powers": lambda p, r, o: np.where(o.random((v := some(p, r)).shape) < 0.5, v, v**2),
    "where with a number": lambda p, r, o: np.where(o.random((v := some(p, r)).shape) < 0.5, v, 2.0),
    "branch": lambda p, r, o: np.where((v := some(p, r)) > 1.0, v, v[..., ::-1]),
    "branch of scales": lambda p, r, o: np.where((v := some(p, r)) > 1.0, v, 2.0 * v),
    "stack with a number": lambda p, r, o: np.stack([v := some(p, r), np.ones(v.shape)]),
    "stack of powers": lambda p, r, o: np.stack([v := some(p, r), v**2], axis=-1),
    "stack of roots": lambda p, r, o: np.stack([v := some(p, r), np.sqrt(v)], axis=-1),
    "one of a broadcast": lambda p, r, o: np.broadcast_arrays(1.5, some(p, r))[0],
    "sum": lambda p, r, o: np.sum(v := some(p, r), axis=axis(v, r)),
    "sum of all": lambda p, r, o: some(p, r).sum(),
    "cumsum": lambda p, r, o: np.cumsum(v := some(p, r), axis=axis(v, r)),
    "prod": lambda p, r, o: np.prod(v := some(p, r), axis=axis(v, r)),
    "product reduced": lambda p, r, o: np.multiply.reduce(v := some(p, r), axis=axis(v, r)),
    "accumulated": lambda p, r, o: np.multiply.accumulate(v := some(p, r), axis=axis(v, r)),
    "dot": lambda p, r, o: np.vecdot(v := some(p, r), v),
    "matvec": lambda p, r, o: np.matvec(o.normal(size=(2, (v := some(p, r)).shape[-1])), v),
    "abs": lambda p, r, o: np.abs(some(p, r)),
    "floor": lambda p, r, o: np.floor(some(p, r)),
    "round": lambda p, r, o: np.round(some(p, r), 2),
    "clip": lambda p, r, o: np.clip(some(p, r), 0.5, 2.0),
    "maximum": lambda p, r, o: np.maximum(some(p, r), 1.0),
    "minimum of two": lambda p, r, o: np.minimum(v := some(p, r), v[..., ::-1]),
    "sort": lambda p, r, o: np.sort(some(p, r), axis=-1),
    "largest": lambda p, r, o: np.max(some(p, r), axis=-1),
    "median": lambda p, r, o: np.median(some(p, r), axis=-1),
    "argsort": lambda p, r, o: (v := some(p, r).reshape(-1))[np.argsort(v)],
    "compared index": lambda p, r, o: (v := some(p, r).reshape(-1))[(v > 1.0) * 1 % v.size],
    "take by itself": lambda p, r, o: np.take(v := some(p, r), (v.reshape(-1) > 1.0) * 1 % v.size),
    "along itself": lambda p, r, o: np.take_along_axis(v := some(p, r), np.argsort(v, -1), -1),
    "choose": lambda p, r, o: np.choose((v := some(p, r)) > 1.0, [v, v[..., ::-1]]),
    "piecewise": lambda p, r, o: np.piecewise(v := some(p, r), [v > 1.0], [2.0, 3.0]),
    "heaviside": lambda p, r, o: np.heaviside((v := some(p, r)) - 1.0, 0.5) * v,
    "sign": lambda p, r, o: np.sign((v := some(p, r)) - 1.0) * v,
    "selected by itself": lambda p, r, o: np.select([(v := some(p, r)) > 1.0], [v], 2.0 * v),
    "select or nothing": lambda p, r, o: np.select([o.random((v := some(p, r)).shape) < 0.5], [v]),
    "copysign": lambda p, r, o: np.copysign(some(p, r), 1.0 - some(p, r)),
    "remainder": lambda p, r, o: some(p, r) % 2.0,
    "exp": lambda p, r, o: np.exp(-some(p, r)),
    "log": lambda p, r, o: np.log(some(p, r)),
    "expm1": lambda p, r, o: np.expm1(-some(p, r)),
    "hypot": lambda p, r, o: np.hypot(v := some(p, r), v),
    "single precision": lambda p, r, o: some(p, r).astype(np.float32),
    "half precision product": lambda p, r, o: np.multiply(some(p, r), 2.0, dtype=np.float16),
    "whole numbers": lambda p, r, o: some(p, r).astype(int) * 1.0,
    "triangle": lambda p, r, o: np.tril(some(p, r)),
    "diagonal matrix": lambda p, r, o: np.diag(some(p, r).reshape(-1)),
    "norm": lambda p, r, o: (v := some(p, r)) / np.linalg.norm(v, axis=-1, keepdims=True),
    "complex": lambda p, r, o: np.abs(some(p, r) * (1.0 + 1.0j)),
    "nan to num": lambda p, r, o: np.nan_to_num(some(p, r)),
}  # fmt: skip
OPERATIONS = GENTLE | HARSH
#: what a program says, and what other parents happen to be
SAID, GIVEN = Restarted(), Restarted()
WEIGHTED = [*GENTLE, *GENTLE, *HARSH]


def run(program: Program, values: Sequence[Any], others: int) -> list[Any]:
    """The pool after every step; other parents take the values that ``others`` stands for."""
    pool = list(values)
    with np.errstate(all="ignore"):
        for name, seed in program:
            rng, other = SAID.at(seed), GIVEN.at((seed, others))
            pool.append(OPERATIONS[name](pool, rng, other))
    return pool


def point(seed: int, size: float = 1.0) -> list[np.ndarray]:
    """Positive values, all unlike each other."""
    rng = np.random.default_rng([3, seed])
    return [
        size * np.exp(rng.uniform(-1.0, 1.0, size=shape)) for shape in reversed(SHAPES.values())
    ]


def valid(steps: Program) -> list[Step]:
    """The steps of a program that NumPy can do at all, results being small."""
    kept: list[Step] = []
    for step in steps:
        try:
            result = run([*kept, step], point(0), 0)[-1]
        except (ValueError, IndexError, TypeError):
            continue
        if isinstance(result, (np.ndarray, np.number)) and result.size <= 60 and result.ndim <= 5:
            kept.append(step)
    return kept


def random_program(seed: int) -> list[Step]:
    rng = np.random.default_rng(seed)
    steps = [
        (WEIGHTED[rng.integers(len(WEIGHTED))], int(rng.integers(1 << 16)))
        for _ in range(rng.integers(1, 7))
    ]
    return valid(steps)


def traced(program: Program) -> Tracer | None:
    """What the tracer makes of a program; None where it refuses or nothing depends on a source."""
    z, x = point(0)
    stand_ins = [Tracer(z, ["z"]), Tracer(x, ["x"], event_ndim=EVENTS["x"])]
    try:
        result = run(program, stand_ins, 0)[-1]
    except Exception:
        return None
    return result if isinstance(result, Tracer) else None


def numbers(program: Program, values: Sequence[np.ndarray], others: int) -> np.ndarray:
    return np.asarray(run(program, values, others)[-1], dtype=float)


def moved(
    values: Sequence[np.ndarray], which: int, element: int, factor: float
) -> list[np.ndarray]:
    """The values with one element of one source multiplied."""
    copies = [v.copy() for v in values]
    copies[which].reshape(-1)[element] *= factor
    return copies


def usual(values: np.ndarray) -> np.ndarray:
    """Where numbers are neither zero nor near the ends of what floats can hold."""
    with np.errstate(all="ignore"):
        size = np.abs(values)
        return np.isfinite(values) & (size > 1e-200) & (size < 1e200)


def read_elements(
    program: Program, which: int, power: float, seed: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """For every element of a result the element of a source it is a power of, -1 where unknown.

    None where some element does not move as that power of one element of the source alone.
    """
    values = point(1, SIZES[seed])
    base = numbers(program, values, seed)
    place = np.full(base.shape, -1)
    hits = np.zeros(base.shape, dtype=int)
    whole = usual(base)
    for element in range(values[which].size):
        factor = FACTORS[(element + seed) % len(FACTORS)]
        new = numbers(program, moved(values, which, element, factor), seed)
        if new.shape != base.shape:
            return None
        known = usual(base) & usual(new)
        whole &= known
        with np.errstate(all="ignore"):
            as_power = np.abs(new / (base * factor**power) - 1.0) < TOLERANCE
            as_before = np.abs(new / base - 1.0) < TOLERANCE
        if (known & ~as_power & ~as_before).any():
            return None
        hits += known & as_power
        place[known & as_power] = element
    if (whole & (hits != 1)).any():
        return None
    return np.where(hits == 1, place, -1), base


def is_power(program: Program, which: int, power: float, event: bool) -> bool:
    """Whether the numbers are powers of one source's elements (and, with ``event``, whole events)."""
    for seed, size in enumerate(SIZES):
        found = read_elements(program, which, power, seed)
        if found is None:
            return False
        if event and not _is_whole(*found, point(1, size)[which], power):
            return False
    return True


def _is_whole(place: np.ndarray, base: np.ndarray, source: np.ndarray, power: float) -> bool:
    """Whether the last axis runs through one vector in order, all components with one factor."""
    if place.ndim == 0 or place.shape[-1] != source.shape[-1]:
        return False
    rows, columns = np.divmod(place, source.shape[-1])
    known = (place >= 0).all(axis=-1)
    with np.errstate(all="ignore"):
        factors = base / source.reshape(-1)[place] ** power
        same = np.abs(factors / factors[..., :1] - 1.0) < TOLERANCE
    ordered = (columns == np.arange(source.shape[-1])) & (rows == rows[..., :1])
    return bool((ordered & same)[known].all())


def is_copy(program: Program, sources: frozenset[str], event: bool) -> bool:
    """Whether all elements are elements of the sources, the same ones whatever these are."""
    for others in (0, 1):
        place = None
        for seed, size in enumerate(SIZES):
            values = dict(zip(("z", "x"), point(seed + 1, size), strict=True))
            pool = np.concatenate([values[s].reshape(-1) for s in sorted(sources)])
            result = numbers(program, [values["z"], values["x"]], others)
            if place is None:
                equal = result[..., None] == pool
                if not (equal.sum(axis=-1) == 1).all():
                    return False
                place = equal.argmax(axis=-1)
            if not np.array_equal(pool[place], result):
                return False
        if event and not _is_whole(place, pool[place], values["x"], 1.0):
            return False
    return True


def lie(program: Program) -> str | None:
    """What the tracer claims of a program although it is not so; None where all is well."""
    result = traced(program)
    if result is None:
        return None
    event = result.whole_event and result.sources == {"x"}
    if result.power is not None:
        (source,) = result.sources
        if not is_power(program, ("z", "x").index(source), result.power, event):
            return f"the power {result.power} of {source}" + " by events" * event
    if result.is_copy and not is_copy(program, result.sources, event):
        return "a copy" + " of events" * event
    if result.event_ndim and result.whole_event and result.power is None and not result.is_copy:
        return "a whole event of something unknown"
    return None


@functools.cache
def programs() -> list[list[Step]]:
    return [random_program(seed) for seed in range(session.scaled(600))]


def test_what_is_claimed_is_so() -> None:
    for program in programs():
        claim = lie(program)
        assert claim is None, f"{[name for name, _ in program]} is not {claim}"


@pytest.mark.parametrize("name", OPERATIONS)
def test_no_operation_lies_alone(name: str) -> None:
    """Every operation by itself, and after others that keep what is claimed."""
    for seed in range(session.scaled(2)):
        for first in (None, "where of two", "scale", "take", "new axis before the event", "power"):
            program = valid([(name, seed)] if first is None else [(first, seed), (name, seed)])
            claim = lie(program)
            assert claim is None, f"{[word for word, _ in program]} is not {claim}"


def test_much_is_claimed() -> None:
    """Were little claimed, the tests of soundness would say nothing."""
    results = [r for r in map(traced, programs()) if r is not None]
    powers = [r.power for r in results if r.power is not None]
    copies = [r for r in results if r.is_copy]
    assert len(powers) > 140
    assert len([p for p in powers if p not in (1.0, -1.0)]) > 36
    assert len(set(powers)) > 8
    assert len(copies) > 60
    assert sum(r.event_ndim == 1 and r.whole_event for r in results) > 40
    assert sum(r.event_ndim == 1 and r.whole_event and not r.is_copy for r in results) > 20


X = Tracer(np.array([[0.3, 1.2, 2.0], [0.7, 4.0, 0.1]]), ["x"], event_ndim=1)
EXACT: dict[str, tuple[Callable[[Any], Any], float | None, bool, bool]] = {
    "itself": (lambda x: x, 1.0, True, True),
    "a precision": (lambda x: 1.0 / np.sqrt(x), -0.5, False, True),
    "a variance": (lambda x: 1.0 / (2.0 * x), -1.0, False, True),
    "a scale of its own": (lambda x: np.array([[1.0], [2.0]]) * x, 1.0, False, True),
    "a scale for each component": (lambda x: np.array([1.0, 2.0, 3.0]) * x, 1.0, False, False),
    "a square by itself": (lambda x: x * x, 2.0, False, True),
    "a component": (lambda x: x[..., 1], 1.0, True, False),
    "a part": (lambda x: x[..., :2], 1.0, True, False),
    "an element": (lambda x: x[0], 1.0, True, True),
    "an element of its components": (lambda x: x[..., 0], 1.0, True, False),
    "with an axis": (lambda x: x[:, None, :], 1.0, True, True),
    "with an axis behind": (lambda x: x[..., None], 1.0, True, False),
    "gathered": (lambda x: x[np.array([1, 0, 1])], 1.0, True, True),
    "taken": (lambda x: np.take(x, [1, 0, 1], axis=0), 1.0, True, True),
    "components taken": (lambda x: np.take(x, [1, 0, 2], axis=-1), 1.0, True, False),
    "reversed": (lambda x: x[..., ::-1], 1.0, True, False),
    "chosen by element": (lambda x: np.where([[True], [False]], x, x[:1]), 1.0, True, True),
    "chosen by component": (
        lambda x: np.where([True, False, True], x, x[:1]), 1.0, True, False,
    ),
    "broadcast": (lambda x: np.broadcast_to(x, (4, 2, 3)), 1.0, True, True),
    "one component broadcast": (lambda x: np.broadcast_to(x[..., :1], (2, 3)), 1.0, True, False),
    "stacked": (lambda x: np.stack([x, x]), 1.0, True, True),
    "stacked at the end": (lambda x: np.stack([x, x], axis=-1), 1.0, True, False),
    "flat": (lambda x: x.reshape(-1), 1.0, True, False),
    "in another shape": (lambda x: x.reshape(2, 1, 3), 1.0, True, True),
    "once itself": (lambda x: 1.0 * x, 1.0, False, True),
    "shifted": (lambda x: x + 1.0, None, False, False),
    "a sum": (lambda x: x.sum(axis=-1), None, False, False),
    "a quotient with itself": (lambda x: x / x, None, False, False),
    "sorted": (lambda x: np.sort(x, axis=0), None, False, False),
    "in single precision": (lambda x: x.astype(np.float32), None, False, False),
    "a power that a parent might be": (lambda x: x ** np.float64(2.0), None, False, False),
}  # fmt: skip


@pytest.mark.parametrize("what", EXACT)
def test_what_is_known_of_common_expressions(what: str) -> None:
    function, power, copied, whole = EXACT[what]
    result = function(X)
    assert (result.power, result.is_copy, result.whole_event) == (power, copied, whole)


def test_scalars_hand_on_whole_events() -> None:
    s = Tracer(np.array([1.0, 2.0]), ["s"])
    assert (s.event_ndim, s.whole_event, np.exp(s).whole_event) == (0, True, True)


def test_a_power_is_of_one_source() -> None:
    x, z = Tracer(1.0, ["x"]), Tracer(2.0, ["z"])
    assert (x * z).power is None
    assert (x / z).power is None
    assert np.where([True, False], x, z).power is None
    assert np.where([True, False], x, z).is_copy
    assert Tracer(1.0, ["x", "z"]).power is None
    assert not Tracer(1.0, ["x", "z"]).is_copy
    unknown = Tracer(np.zeros(3), ["x"], "something in node 'a'", event_ndim=1)
    assert (unknown.power, unknown.is_copy, unknown.whole_event) == (None, False, False)


def test_the_same_component_twice() -> None:
    assert (X[..., 0] * X[..., 0]).power == 2.0
    assert (X[..., 0] / np.sqrt(X[..., 0])).power == 0.5
    assert (X[..., 0] * X[..., 1]).power is None
    assert (
        X[..., np.array([0])] * X[..., np.array([0])]
    ).power is None  # may be two parents' values


WRONG: dict[str, tuple[str, Any]] = {
    "floors are powers": ("_POWERS", {np.floor: 1.0}),
    "the exponential is a power": ("_POWERS", {np.expm1: 1.0}),
    "logarithms are powers": ("_POWERS", {np.log: 1.0}),
    "roots are squares": ("_POWERS", {np.sqrt: 2.0}),
    "sorting moves": ("_MOVERS", {np.sort}),
    "the largest is one of them": ("_MOVERS", {np.max}),
    "clipping moves": ("_MOVERS", {np.clip}),
    "sums move": ("_MOVERS", {np.sum}),
    "triangles move": ("_MOVERS", {np.tril}),
    "all values are aligned": ("_aligned", lambda first, second: True),
    "factors are the same all over": ("_is_flat", lambda value, event_ndim: True),
    "events are out of reach": ("_spares", lambda span, ndim, event_ndim: True),
    "all keys are plain": ("_is_plain", lambda key: True),
}


@pytest.mark.parametrize("rule", WRONG)
def test_a_wrong_rule_is_caught(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: one wrong rule, and random programs find a lie."""
    table, wrong = WRONG[rule]
    right = getattr(claims, table)
    monkeypatch.setattr(claims, table, wrong if callable(wrong) else right | wrong)
    more = (random_program(seed) for seed in range(3000))
    found = next((program for program in more if lie(program)), None)
    assert found is not None
    monkeypatch.undo()
    assert lie(found) is None  # it is the rule that lied


# ---- axes --------------------------------------------------------------------------------------------


def random_key(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[Any, ...]:
    parts: list[Any] = [
        None, Ellipsis, slice(None), slice(None), slice(None, None, -1), 0, np.int64(1),
        np.array([1, 0]), np.array([[1], [0]]), [0, 1, 1],
    ]  # fmt: skip
    key = [parts[rng.integers(len(parts))] for _ in range(rng.integers(5))]
    if shape and rng.random() < 0.2:
        key.append(rng.random(shape[-1]) < 0.6)
    return tuple(key)


def test_what_a_key_leaves_alone_stays_where_it_was() -> None:
    """Axes before the span keep their place from the left, axes behind it from the right."""
    rng = np.random.default_rng(0)
    tried = spared = 0
    for _ in range(2000):
        shape = tuple(rng.integers(2, 5, size=rng.integers(5)))
        key = random_key(rng, shape)
        value = np.arange(np.prod(shape, dtype=int)).reshape(shape)
        try:
            result = value[key]
        except IndexError:
            continue
        span = axes.index_span(key, value.ndim)
        if result.size == 0 or span is None:
            continue
        tried += 1
        at = np.unravel_index(result, shape) if shape else ()
        for k, size in enumerate(shape):
            places = []
            if k < span[0] and span != axes.KEPT:
                places.append(k)
            if k >= span[1]:
                places.append(result.ndim - value.ndim + k)
            for place in places:
                spared += 1
                assert result.shape[place] == size
                along = np.arange(size).reshape((-1,) + (1,) * (result.ndim - 1 - place))
                assert (at[k] == along).all(), (shape, key)
    assert tried > 1000
    assert spared > 500
