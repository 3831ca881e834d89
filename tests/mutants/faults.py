"""Planting a fault: one snippet of a library function exchanged for another while a test runs.

The function itself is changed (its code object), so that every module that holds it, and every instance, runs
the fault. A snippet that is no longer there, or that occurs twice, is an error: the library has moved on, and
the fault must be written anew. What a fault does, and who should notice, is not known here.
"""

from __future__ import annotations
import __future__

import ast
import functools
import importlib
import inspect
import textwrap
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any


@dataclass(frozen=True)
class Edit:
    """A function of the library with snippets exchanged.

    Attributes
    ----------
    where : str
        Module and qualified name, ``"bayesmc.kernels.proposed:Proposed.step"``.
    old, new : str
        The snippet, which occurs once in the function, and what stands there instead.
    also : tuple of pairs of str
        Further ones.
    """

    where: str
    old: str
    new: str
    also: tuple[tuple[str, str], ...] = ()

    @contextmanager
    def planted(self) -> Iterator[None]:
        """The function with the fault, for as long as the block lasts."""
        function = _function(_found(self.where), self.where)
        right = function.__code__
        function.__code__ = self._compiled(function)
        try:
            yield
        finally:
            function.__code__ = right

    def _compiled(self, function: FunctionType) -> CodeType:
        lines, _ = inspect.getsourcelines(function.__code__)
        right = source = textwrap.dedent("".join(lines))
        for old, new in ((self.old, self.new), *self.also):
            count = source.count(old)
            if count != 1:
                raise StaleFault(f"{self.where} holds {old!r} {count} times, not once")
            source = source.replace(old, new)
        code = _recompiled(source, function)
        if _meaning(code) == _meaning(_recompiled(right, function)):
            raise StaleFault(f"{self.where}: {self.new!r} for {self.old!r} changes nothing")
        return code


@dataclass(frozen=True)
class Constant:
    """A module's constant, or an attribute of a class, with another value.

    Attributes
    ----------
    where : str
        As of an `Edit`.
    value : object
    """

    where: str
    value: Any

    @contextmanager
    def planted(self) -> Iterator[None]:
        """The other value, for as long as the block lasts."""
        module, _, path = self.where.partition(":")
        holder, _, name = path.rpartition(".")
        owner = _found(f"{module}:{holder}") if holder else importlib.import_module(module)
        right = vars(owner)[name]
        if right == self.value:
            raise StaleFault(f"{self.where} is {self.value!r} already")
        setattr(owner, name, self.value)
        try:
            yield
        finally:
            setattr(owner, name, right)


Fault = Edit | Constant


class StaleFault(LookupError):
    """The library is no longer what a fault was written for."""


@contextmanager
def planted(*faults: Fault) -> Iterator[None]:
    """Several places changed as one fault."""
    with ExitStack() as stack:
        for fault in faults:
            stack.enter_context(fault.planted())
        yield


# ---- private ------------------------------------------------------------------------------------


def _found(where: str) -> Any:
    module, _, path = where.partition(":")
    found: Any = importlib.import_module(module)
    for name in path.split("."):
        found = inspect.getattr_static(found, name, None)
        if found is None:
            raise StaleFault(f"{where}: there is no {name!r}")
    return found


def _function(found: Any, where: str) -> FunctionType:
    """The plain function inside a method of any kind."""
    if isinstance(found, (staticmethod, classmethod)):
        found = found.__func__
    elif isinstance(found, property):
        found = found.fget
    elif isinstance(found, functools.cached_property):
        found = found.func
    if not isinstance(found, FunctionType):
        raise StaleFault(f"{where} is no function")
    return found


def _recompiled(source: str, function: FunctionType) -> CodeType:
    """The code of a function's changed source, with the variables of its closure free as before."""
    tree = ast.parse(source)
    definition = tree.body[0]
    assert isinstance(definition, ast.FunctionDef)
    definition.decorator_list = []
    ast.increment_lineno(tree, function.__code__.co_firstlineno - 1)
    free = function.__code__.co_freevars
    if free:  # such as __class__, where super() is called
        outer = ast.parse("def outer():\n    " + " = ".join(free) + " = None").body[0]
        assert isinstance(outer, ast.FunctionDef)
        outer.body.append(definition)
        tree.body = [outer]
    flags = __future__.annotations.compiler_flag
    code = compile(tree, function.__code__.co_filename, "exec", flags, dont_inherit=True)
    for _ in range(2 if free else 1):
        code = next(c for c in code.co_consts if isinstance(c, CodeType))
    if code.co_freevars != free:
        raise StaleFault(f"{function.__qualname__}: the fault needs other variables than {free}")
    return code


def _meaning(code: CodeType) -> tuple[Any, ...]:
    """What a code object does, wherever it stands."""
    consts = tuple(_meaning(c) if isinstance(c, CodeType) else c for c in code.co_consts)
    return code.co_code, consts, code.co_names, code.co_varnames
