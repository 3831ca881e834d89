"""Random functions of the kind that users write: NumPy calls that broadcast over a batch in front.

A function is drawn as a list of steps; it can be called with arrays or with stand-ins. Its arguments have
a batch, then the plate, then the event of a vector; values stay moderate, and away from jumps and edges.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

import bayesmc as bmc

PLATE, EVENT, STATES = 4, 3, 5
#: name -> (shape of one entry, type)
ARGUMENTS = {
    "a": ((), float),
    "b": ((PLATE,), float),
    "v": ((EVENT,), float),
    "w": ((PLATE, EVENT), float),
    "k": ((), int),
    "z": ((PLATE,), int),
}
TABLE = np.linspace(-1.0, 1.5, STATES)
DESIGN = np.sin(np.arange(PLATE * EVENT).reshape(PLATE, EVENT))
SQUARE = np.cos(np.arange(EVENT * EVENT).reshape(EVENT, EVENT)) + 3 * np.eye(EVENT)

Step = tuple[str, Callable[..., Any], tuple[int, ...]]

_UNARY: dict[str, Callable[[Any], Any]] = {
    "exp": lambda x: np.exp(0.3 * np.tanh(x)), "log": lambda x: np.log(x * x + 1.0), "sin": np.sin,
    "sqrt": lambda x: np.sqrt(np.abs(x) + 0.5), "tanh": np.tanh, "square": lambda x: np.tanh(x) ** 2,
    "expit": special.expit, "gammaln": lambda x: special.gammaln(1.5 + special.expit(x)),
    "negative": lambda x: -x, "reciprocal": lambda x: 1.0 / (2.0 + np.cos(x)), "abs": np.abs,
    "clip": lambda x: np.clip(x, -1.5, 1.5), "where": lambda x: np.where(x > 0.1, x, 0.5 * x),
    "round": lambda x: x - np.round(3.0 * x), "log1p": lambda x: np.log1p(x**2), "cbrt": lambda x: np.cbrt(x),
    "nan_to_num": lambda x: np.nan_to_num(x), "arctan": lambda x: np.arctan(2 * x),
}  # fmt: skip
_BINARY: dict[str, Callable[[Any, Any], Any]] = {
    "add": lambda x, y: x + y, "subtract": lambda x, y: x - y, "multiply": lambda x, y: np.tanh(x) * y,
    "divide": lambda x, y: x / (1.5 + np.sin(y)), "maximum": np.maximum, "hypot": np.hypot,
    "arctan2": lambda x, y: np.arctan2(x, 2.5 + np.cos(y)),
    "power": lambda x, y: (1 + np.abs(x)) ** np.tanh(y),
    "logaddexp": np.logaddexp, "where": lambda x, y: np.where(x < y, x, y),
}  # fmt: skip
#: of vectors on the last axis
_VECTOR: dict[str, Callable[[Any], Any]] = {
    "reverse": lambda x: x[..., ::-1], "sum": lambda x: x.sum(axis=-1, keepdims=True) + 0.0 * x,
    "cumsum": lambda x: 0.5 * np.cumsum(x, axis=-1), "cumprod": lambda x: np.cumprod(np.tanh(x), axis=-1),
    "roll": lambda x: np.roll(x, 1, axis=-1),
    "matvec": lambda x: np.matvec(SQUARE, x) / 4, "pick": lambda x: x[..., [2, 0, 0]],
    "stack": lambda x: bmc.stack([x[..., 0], x[..., 2], np.sin(x[..., 1])]),
    "softmax": lambda x: special.softmax(x, axis=-1),
    "logsumexp": lambda x: x - special.logsumexp(x, axis=-1, keepdims=True),
    "mean": lambda x: x - np.mean(x, axis=-1, keepdims=True),
    "einsum": lambda x: np.einsum("...i,ij->...j", x, SQUARE) / 4,
    "concatenate": lambda x: np.concatenate([x[..., 1:], x[..., :1] ** 2 / (1 + x[..., :1] ** 2)], axis=-1),
    "solve": lambda x: np.linalg.solve(SQUARE, x[..., None])[..., 0],
    "norm": lambda x: x / (1 + np.linalg.norm(x + 0.1, axis=-1, keepdims=True)),
    "max": lambda x: x - 0.5 * np.max(x, axis=-1, keepdims=True), "sort": lambda x: np.sort(x, axis=-1),
    "filled": lambda x: _filled(x),
    "diff": lambda x: np.concatenate([x[..., :1], np.diff(x, axis=-1)], axis=-1),
    "outer": lambda x: np.sum(x[..., :, None] * np.tanh(x)[..., None, :], axis=-1) / 3,
    "prod": lambda x: np.prod(np.tanh(x), axis=-1, keepdims=True) * x,
}  # fmt: skip
#: of vectors, to numbers
_DOWN: dict[str, Callable[[Any], Any]] = {
    "component": lambda x: x[..., 1], "vecdot": lambda x: np.vecdot(x, np.array([0.3, -0.2, 0.5])),
    "logsumexp": lambda x: special.logsumexp(x, axis=-1), "var": lambda x: np.var(x, axis=-1),
    "norm": lambda x: np.linalg.norm(x + 2.0, axis=-1), "reduce": lambda x: np.logaddexp.reduce(x, axis=-1),
}  # fmt: skip
#: of finite parents, to real numbers
_STATE: dict[str, Callable[[Any], Any]] = {
    "table": lambda k: TABLE[k], "equal": lambda k: np.where(k == 2, 1.3, -0.4),
    "number": lambda k: 0.2 * k, "select": lambda k: np.select([k == 0, k < 3], [0.3, -1.0], 0.8),
    "rows": lambda k: DESIGN[np.minimum(k, PLATE - 1), 1], "choose": lambda k: np.take(TABLE, k),
    "isin": lambda k: 1.0 * np.isin(k, [1, 4]),
}  # fmt: skip


def _filled(x: Any) -> Any:
    out = np.zeros_like(x) + x
    out[..., 0] = np.tanh(x[..., 2])
    return out


def written(steps: list[Step]) -> Callable[..., Any]:
    """The steps as a function; the first operands are the arguments."""
    names = list(ARGUMENTS)
    lines = [f"def function({', '.join(names)}):"]
    scope: dict[str, Any] = {}
    for number, (name, step, operands) in enumerate(steps):
        scope[f"{name}_{number}"] = step
        lines.append(f"    x{number} = {name}_{number}({', '.join(names[k] for k in operands)})")
        names.append(f"x{number}")
    lines.append(f"    return {names[-1]}")
    exec("\n".join(lines), scope)
    function = scope["function"]
    function.__doc__ = "\n".join(lines)
    return function


def random_function(rng: np.random.Generator, steps: int = 8) -> Callable[..., Any]:
    """A function whose last step reads what came before; entries of shape () or (PLATE,)."""
    numbers, vectors = [0, 1], [2, 3]
    made: list[Step] = []

    def step(room: dict[str, Callable[..., Any]], operands: list[int], kept: list[int]) -> None:
        name = str(rng.choice(list(room)))
        made.append((name, room[name], tuple(operands)))
        kept.append(len(ARGUMENTS) + len(made) - 1)

    def any_of(values: list[int]) -> int:
        return values[-1] if rng.random() < 0.5 else int(rng.choice(values))

    for _ in range(steps):
        kind = rng.choice(["unary", "binary", "vector", "down", "state", "wide"])
        if kind == "unary":
            step(_UNARY, [any_of(numbers)], numbers)
        elif kind == "binary":
            step(_BINARY, [any_of(numbers), any_of(numbers)], numbers)
        elif kind == "vector":
            step(_VECTOR, [any_of(vectors)], vectors)
        elif kind == "down":
            step(_DOWN, [any_of(vectors)], numbers)
        elif kind == "state":
            step(_STATE, [int(rng.choice([4, 5]))], numbers)
        else:
            made.append(("wide", lambda x, v: x[..., None] * v, (any_of(numbers), any_of(vectors))))
            vectors.append(len(ARGUMENTS) + len(made) - 1)
    step(_DOWN, [vectors[-1]], numbers)
    step(_BINARY, [numbers[-1], numbers[-2]], numbers)
    return written(made)


def random_arguments(
    rng: np.random.Generator, batches: dict[str, tuple[int, ...]]
) -> dict[str, np.ndarray]:
    """Values of the arguments, each with a batch of its own."""
    found = {}
    for name, (shape, dtype) in ARGUMENTS.items():
        full = batches[name] + shape
        if name in ("a", "v", "k"):  # in the plate, as a parent without it arrives
            full = batches[name] + (1, *shape)
        found[name] = rng.integers(STATES, size=full) if dtype is int else rng.normal(size=full)
    return found
