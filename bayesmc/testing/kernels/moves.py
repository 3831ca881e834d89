"""Whatever moves states, with the joint law it is held against, in one form for all tests of kernels.

Engines, single kernels of ours (`machines`), functions that a user wrote (`steps`), and those of models that
are no nets. What a test makes of a move is not known here.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import ModelError, UnsupportedError
from bayesmc.testing.kernels.joint import (
    JointModel,
    Move,
    NetJoint,
    Statistics,
    check_sizes,
    check_statistics,
)
from bayesmc.testing.kernels.machines import Machine
from bayesmc.testing.kernels.statistics import default_statistics
from bayesmc.testing.kernels.steps import StepFunction, is_step, takes
from bayesmc.testing.verdict import Comparison


@dataclass(frozen=True, eq=False)
class Moves:
    """A kernel ready for a test.

    Attributes
    ----------
    prior, simulate, statistics
        Of the joint law, in the form that the moves take.
    forward : callable
    backward : callable or None
        The reverse; None where it is not known, and ``why`` says why.
    faults : tuple of Comparison
        What is wrong for certain, before any test.
    is_quick : bool
        False where the kernel is compiled anew for every data set.
    is_own_reverse : bool
        Whether a function was taken for its own reverse, for want of another.
    """

    prior: Callable[[np.random.Generator, int], Any]
    simulate: Callable[[Any, np.random.Generator], Any]
    statistics: Statistics
    forward: Move
    backward: Move | None
    faults: tuple[Comparison, ...] = ()
    why: str = ""
    is_quick: bool = True
    is_own_reverse: bool = False


def moves_of(
    call: str,
    kernel: Any,
    net: Any,
    *,
    reverse: Any = None,
    observed: Any = None,
    inputs: Any = None,
    statistics: Mapping[str, Callable[..., Any]] | None = None,
    batched: bool = False,
    warmup: int | None = None,
    rows: int,
) -> Moves:
    """A kernel of any kind on a net or `JointModel`, with the joint law it is held against."""
    if isinstance(net, JointModel):
        return _of_model(call, kernel, net, reverse, observed, inputs, statistics)
    if warmup is not None:
        check_sizes(call, warmup=(warmup, 0))
    joint = NetJoint(net, observed, inputs)
    found = default_statistics(joint) if statistics is None else joint.read(call, statistics)
    if is_step(kernel):
        forward = _of_function(call, kernel, joint, batched)
        backward = forward if reverse is None else _of_function(call, reverse, joint, batched)
        return Moves(
            joint.prior, joint.simulate, found, forward, backward, is_own_reverse=reverse is None
        )
    machine = Machine(call, kernel, joint, warmup)
    machine.prepare(rows)
    back = machine.backward
    if reverse is not None:
        back = Machine(call, reverse, joint, warmup).from_elsewhere
    return Moves(
        machine.prior, machine.simulate, machine.grouped(found), machine.forward, back,
        machine.faults, machine.why, machine.is_given, machine.is_own_reverse and reverse is None,
    )  # fmt: skip


# ---- private ------------------------------------------------------------------------------------


def _of_model(
    call: str,
    kernel: Any,
    model: JointModel,
    reverse: Any,
    observed: Any,
    inputs: Any,
    statistics: Any,
) -> Moves:
    for name, given in (("observed", observed), ("inputs", inputs), ("statistics", statistics)):
        if given is not None:
            raise ModelError(f"{call}({name}=...): a JointModel has its own")
    for move in (kernel, reverse):
        if move is not None and not callable(move):
            raise UnsupportedError(
                f"{call}: with a JointModel give kernel(state, data, rng) -> state, not {move!r}"
            )
    for name in ("prior", "simulate"):
        if not callable(getattr(model, name)):
            raise ModelError(f"{call}: JointModel({name}=...) is no function")
    for name, move in (("kernel", kernel), ("reverse", reverse)):
        if move is not None and not takes(move, 3):
            raise ModelError(
                f"{call}: with a JointModel the {name} is called with (state, data, rng), which "
                f"{inspect.signature(move)} does not take"
            )
    check_statistics(call, model.statistics, "statistic(state, data)")
    forward = _returning(call, "kernel(state, data, rng)", kernel)
    return Moves(
        _returning(call, "prior(rng, n)", model.prior),
        model.simulate,  # data may be None
        model.statistics,
        forward,
        forward if reverse is None else _returning(call, "reverse(state, data, rng)", reverse),
        is_own_reverse=reverse is None,
    )


def _returning(call: str, what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which must not forget to return something."""

    def checked(*arguments: Any) -> Any:
        found = function(*arguments)
        if found is None:
            raise ModelError(
                f"{call}: {what} of the JointModel returned None; return arrays of rows"
            )
        return found

    return checked


def _of_function(call: str, step: Any, joint: NetJoint, batched: bool) -> Move:
    if not is_step(step):
        raise UnsupportedError(
            f"{call}: {step!r} is no function step(state, rng) -> state, as the other direction is"
        )
    return StepFunction(call, step, joint, batched)
