"""Every docstring example of the package runs, and every public name has one."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil

import pytest

import bayesmc

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
MODULES = ["bayesmc", *(m.name for m in pkgutil.walk_packages(bayesmc.__path__, "bayesmc."))]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    module = importlib.import_module(name)
    result = doctest.testmod(module, optionflags=OPTIONS)
    assert result.failed == 0  # doctest has printed what differed


def public_objects() -> list[tuple[str, object]]:
    """Classes and functions of ``bayesmc.__all__``; errors and warnings explain themselves."""
    named = [(name, getattr(bayesmc, name)) for name in bayesmc.__all__]
    return [
        (name, value)
        for name, value in named
        if inspect.isroutine(value) or (inspect.isclass(value) and not issubclass(value, Exception))
    ]


def test_public_names_have_an_example() -> None:
    without = [name for name, value in public_objects() if ">>>" not in (value.__doc__ or "")]
    assert without == []


def test_public_names_exist() -> None:
    assert len(public_objects()) > 20
    assert set(bayesmc.__all__) <= set(dir(bayesmc))


def test_wrong_example_is_found() -> None:
    example = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "planted", None, None)
    runner = doctest.DocTestRunner(verbose=False, optionflags=OPTIONS)
    assert runner.run(example, out=lambda text: None).failed == 1
