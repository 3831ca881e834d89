"""A graph as one function of machine code: a loop over a batch, and what is written inside of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesmc.expression import Call, Expression, Leaf
from bayesmc.lowering.code import WHOLE, Code, Module, Number
from bayesmc.lowering.kept import keep, together
from bayesmc.lowering.layout import is_few, laid_out
from bayesmc.lowering.places import flat, plus, times
from bayesmc.lowering.schedule import scheduled
from bayesmc.lowering.writer import DTYPES, ROWS, Place, Writer

#: the name of the function in the machine code
ENTRY = "bayesmc_kernel"
#: that of the one whose varying leaf and results are arguments of their own
DIRECT = "bayesmc_direct"


class Kernel:
    """The text of a function of many entries.

    ``int32 f(int64 entries, void** arguments)``: arguments are addresses, in the order of ``leaves``, the
    constants (real, whole, true), what is kept of one entry (one for each), the roots. The result is 0, or
    the bits of ``lowering.ufuncs`` for what could not be done.

    Where one leaf varies there is another: ``int32 f(int64 entries, leaf, results ..., arguments)``.

    Parameters
    ----------
    roots : sequence of Expression
    varying : frozenset of str
        Leaves that have values of their own for each entry; of the others there is one.
    chosen : frozenset of str, optional
        Of those the ones whose value is that of another entry: which, is an argument behind what is kept.

    Attributes
    ----------
    text : str
    leaves : list of Leaf
    constants : dict
        Type -> all constants of it, one after the other.
    kept : list of Expression
        Of which the function needs memory for one entry.

    Raises
    ------
    TraceError
        Something has no machine code.
    """

    def __init__(
        self,
        roots: Sequence[Expression],
        varying: frozenset[str],
        chosen: frozenset[str] = frozenset(),
    ) -> None:
        layout = laid_out(roots)
        self.varying, self.chosen = varying, chosen
        self.leaves = [n for n in layout.nodes if isinstance(n, Leaf)]
        self.kept = [n for n in layout.nodes if n in layout.kept]
        self._writer = w = Writer(layout, varying, chosen)
        names = [*self.leaves, *DTYPES, *self.kept, *([ROWS] if chosen else []), *range(len(roots))]
        for k, what in enumerate(names):
            w.pointers[what] = f"%p{k}"
        self._write(roots)
        self.text = self._function(len(names), len(roots))
        self.foreign = w.code.module.foreign
        self.constants = w.constants

    # ---- private -------------------------------------------------------------------------------

    def _write(self, roots: Sequence[Expression]) -> None:
        w = self._writer
        varies = [n for n in w.layout.nodes if n.leaves & self.varying]
        self._prepare_all([n for n in w.layout.nodes if not n.leaves & self.varying])

        def entry(i: Number) -> None:
            w.entry = w.row = i
            if self.chosen:
                w.row = w.code.load(w.pointers[ROWS], i, WHOLE)
            self._prepare_all(varies)
            for k, root in enumerate(roots):
                self._result(k, root)

        w.loop(Number(w.code, "%entries", WHOLE), entry)

    def _function(self, count: int, results: int) -> str:
        code, module = self._writer.code, self._writer.code.module
        flags = code.op("i32", f"trunc i64 {code.flags.text} to i32")
        code.do(f"ret i32 {flags.text}")
        pointers = ", ".join(f"ptr noalias %p{k}" for k in range(count))
        body = f"define internal i32 @body(i64 %entries, {pointers}) noinline {{\n{code}\n}}"
        direct = [k for k, n in enumerate(self.leaves) if n.name in self.varying]
        ends = range(count - results, count)
        outer = _entry(module, ENTRY, count, [])
        other = _entry(module, DIRECT, count, [*direct, *ends]) if len(direct) == 1 else ""
        return f"{module}\n{body}\n{outer}\n{other}\n"

    def _prepare_all(self, nodes: Sequence[Expression]) -> None:
        """What later loops read, computed now."""
        for group in scheduled(nodes, self._writer.layout):
            if len(group) > 1:
                together(self._writer, group)
            else:
                self._prepare(group[0])

    def _prepare(self, node: Expression) -> None:
        w = self._writer
        is_kept = node in w.layout.kept
        if is_few(node) and not isinstance(node, Call):
            for k, at in enumerate(np.ndindex(node.shape)):
                value = w.element(node, at)
                if is_kept:
                    w.code.store(w.pointers[node], k, value)
        elif is_kept:
            keep(w, node)
        if is_kept:
            w.ready.add(node)

    def _result(self, number: int, root: Expression) -> None:
        w = self._writer
        pointer = w.pointers[number]
        first = times(w.entry, root.size) if root.leaves & self.varying else 0

        def put(at: Place) -> None:
            place = plus(first, flat(root.shape, at))
            w.code.store(pointer, place, w.element(root, at))

        if is_few(root):
            for at in np.ndindex(root.shape):
                put(at)
        else:
            w.nest(root.shape, put)


# ---- private ------------------------------------------------------------------------------------


def _entry(module: Module, name: str, count: int, given: Sequence[int]) -> str:
    """A function that takes some pointers as they are, and looks up the others."""
    code = Code(module)
    pointers = [
        f"%a{k}" if k in given else code.load("%arguments", k, "ptr").text for k in range(count)
    ]
    args = ", ".join(f"ptr {p}" for p in pointers)
    found = code.op("i32", f"call i32 @body(i64 %entries, {args})")
    code.do(f"ret i32 {found.text}")
    own = "".join(f"ptr %a{k}, " for k in given)
    return f"define i32 @{name}(i64 %entries, {own}ptr %arguments) {{\n{code}\n}}"
