"""Loops of particle filters over all particles, which no element-wise expression says.

Weights from their logs with their sums in one pass, and resampling: the same numbers, to rounding, as
``resampling.systematic`` and ``stratified`` give.

References
----------
Carpenter, Clifford and Fearnhead (1999), IEE Proceedings F 146; Murray, Lee and Jacob (2016), JCGS 25(3)
(ancestors by a running maximum).
"""

from __future__ import annotations

from bayesmc.lowering.code import REAL, WHOLE, Code, Module, Number
from bayesmc.lowering.elementary import elementary

#: sums of weights between which their scale does not matter
SMALL, LARGE = 1e-200, 1e200


def loops(module: Module) -> list[str]:
    """Functions ``exponentials`` and ``running``; ``systematic`` and ``stratified``, which give ancestors."""
    return [
        _exponentials(module),
        _running(module),
        _ancestors(module, "systematic"),
        _ancestors(module, "stratified"),
    ]


# ---- private ------------------------------------------------------------------------------------


def _exponentials(module: Module) -> str:
    c = Code(module)
    zero = c.number(0.0)
    total, squares = c.variable(zero), c.variable(zero)

    def body(i: Number) -> None:
        weight = elementary(c, "exp", c.load("%log", i, REAL) - Number(c, "%level", REAL))
        c.store("%weights", i, weight)
        for place, part in ((total, weight), (squares, weight * weight)):
            old = c.get(place, REAL)
            c.set(place, c.op(REAL, f"fadd reassoc double {old.text}, {part.text}"))

    c.loop(Number(c, "%n", WHOLE), body)
    c.store("%sums", 0, c.get(total, REAL))
    c.store("%sums", 1, c.get(squares, REAL))
    c.do("ret void")
    head = "i64 %n, double %level, ptr noalias %log, ptr noalias %weights, ptr noalias %sums"
    return f"define void @exponentials({head}) {{\n{c}\n}}"


def _running(module: Module) -> str:
    c = Code(module)
    total = c.variable(c.number(0.0))

    def body(i: Number) -> None:
        found = c.get(total, REAL) + c.load("%weights", i, REAL)
        c.set(total, found)
        c.store("%running", i, found)

    c.loop(Number(c, "%n", WHOLE), body)
    c.do(f"ret double {c.get(total, REAL).text}")
    head = "i64 %n, ptr noalias %weights, ptr noalias %running"
    return f"define double @running({head}) {{\n{c}\n}}"


def _ancestors(module: Module, name: str) -> str:
    """Every particle writes its number where its offspring begin; a running maximum fills the rest.

    The comb is shifted by one number, or the point of each stratum by its own (one more is beyond reach).
    """
    c = Code(module)
    draws = Number(c, "%draws", WHOLE)
    scale, last = Number(c, "%scale", REAL), Number(c, "%last", REAL)
    is_comb = name == "systematic"
    start = c.variable(c.number(0, WHOLE))

    def begin(i: Number) -> None:
        c.store("%found", c.get(start, WHOLE), i)
        position = c.load("%running", i, REAL) * scale
        position = position + Number(c, "%shift", REAL) if is_comb else position
        edge = position.to(WHOLE)
        if not is_comb:
            point = c.load("%points", c.where(edge > draws, draws, edge), REAL)
            edge = edge + (position - edge.to(REAL) > point).to(WHOLE)
        is_end = (position >= last) | (edge > draws)
        c.set(start, c.where(is_end, draws, edge))

    c.loop(Number(c, "%n", WHOLE), begin)
    top = c.variable(c.number(0, WHOLE))

    def fill(j: Number) -> None:
        old, own = c.get(top, WHOLE), c.load("%found", j, WHOLE)
        found = c.where(own > old, own, old)
        c.set(top, found)
        c.store("%found", j, found)

    c.loop(draws, fill)
    c.do("ret void")
    more = "double %shift" if is_comb else "ptr noalias %points"
    head = f"i64 %n, i64 %draws, double %scale, double %last, {more}, ptr noalias %running"
    return f"define void @{name}({head}, ptr noalias %found) {{\n{c}\n}}"
