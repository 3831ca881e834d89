"""Holds the layers of the package: imports point down only, heavy libraries load when first used.

The modules are read, not run: every import statement is found in the syntax tree, those inside
functions and under ``TYPE_CHECKING`` included; only a cycle within a room may be closed by an
import for types. Such cycles, and modules and functions that are too long, are listed below: the
lists may only shrink. Planted violations show that each rule can fail.
"""

from __future__ import annotations

import ast
import functools
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import bayesmc
from tests.counts.lines import long_functions, long_modules, parsed, sources

PACKAGE = Path(__file__).resolve().parents[1] / "bayesmc"

# Top to bottom. A package counts as one room; rooms on one line do not import each other.
LAYERS = """
__main__
robotics | vision | plotting | io | testing | sklearn
learning
auto
pmcmc
engines
kernels
workers
dbn | structure | results
network
factors | montecarlo
passes | lowering
distributions
expression
linalg
resampling | gaussian | diagnostics | markov | plates | states | randomness | progress | storage | drawing
categorical
errors | shapes | objects
"""
DEPTH = {
    room.strip(): depth
    for depth, line in enumerate(LAYERS.strip().splitlines())
    for room in line.split("|")
}

#: modules above 450 lines
LONG_MODULES: set[str] = set()
#: functions above 60 lines, docstrings apart
LONG_FUNCTIONS: set[str] = set()
#: modules that import each other for types
TYPE_CIRCLES: set[str] = set()

HEAVY = ("scipy.stats", "networkx", "arviz_stats", "arviz_base", "matplotlib", "hypothesis",
         "tqdm", "numba", "llvmlite", "PIL", "yaml", "pandas", "h5py", "h5netcdf",
         "skimage", "sklearn")  # fmt: skip
#: rooms that extend classes of a heavy library, which loads with them; nothing imports these rooms
ADAPTERS = {"sklearn": "sklearn"}


def violations(sources: dict[str, str]) -> list[str]:
    """What is wrong with modules given as dotted name -> source text; empty when all is well."""
    found, graph = [], {}
    for name, source in sources.items():
        imports = _imports(name, source)
        graph[name] = {target for target, _, _, only_types in imports if not only_types}
        for target, line, in_function, only_types in imports:
            where = f"{name}:{line}"
            if target.split(".")[0] == "bayesmc":
                found += _knots(name, target, where, in_function)
            elif ADAPTERS.get(_room(name)) == target.split(".")[0]:
                continue
            elif not in_function and not only_types and _is_heavy(target):
                found.append(f"{where}: imports {target} at module level, not where it is used")
        found += _rooms(name)
    return found + _cycles(_between_modules(graph))


def _knots(name: str, target: str, where: str, in_function: bool) -> Iterator[str]:
    if in_function:
        yield f"{where}: imports {target} inside a function"
    here, there = _room(name), _room(target)
    if here in ("", there) or here not in DEPTH:
        return
    if there == "":
        yield f"{where}: imports the package itself, which stands above everything"
    elif DEPTH.get(there, -1) <= DEPTH[here]:
        yield f"{where}: {here} imports {there}, which does not stand below it"


def _rooms(name: str) -> list[str]:
    room = _room(name)
    known = room == "" or room in DEPTH
    return [] if known else [f"{name}: the room {room!r} has no place in LAYERS"]


def _room(name: str) -> str:
    """First part below the package: ``engines`` of ``bayesmc.engines.exact``; '' for itself."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] != "__init__" else ""


def _is_heavy(target: str) -> bool:
    return any(target == heavy or target.startswith(heavy + ".") for heavy in HEAVY)


@functools.lru_cache(maxsize=2048)
def _imports(name: str, source: str) -> list[tuple[str, int, bool, bool]]:
    """``(imported dotted name, line, inside a function, under TYPE_CHECKING)`` of every import."""

    def walk(node: ast.AST, in_function: bool, only_types: bool) -> Iterator:
        for child in ast.iter_child_nodes(node):
            line = getattr(child, "lineno", 0)
            for target in _targets(name, child):
                yield target, line, in_function, only_types
            inside = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            types = isinstance(child, ast.If) and _is_of_types(child.test)
            yield from walk(child, in_function or inside, only_types or types)

    return list(walk(parsed(source), False, False))


def _is_of_types(test: ast.expr) -> bool:
    name = getattr(test, "attr", None) or getattr(test, "id", "")
    return name == "TYPE_CHECKING"


def _targets(name: str, node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            package = name.removesuffix(".__init__").split(".")
            climb = node.level - name.endswith(".__init__")
            base = ".".join([*package[: len(package) - climb], *([base] if base else [])])
        # `from bayesmc import network` names a module, `from scipy import stats` too
        yield from (f"{base}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Call) and _called(node) in ("import_module", "__import__"):
        # The lazy package namespace is the one place that may load bayesmc modules by name.
        constant = node.args and isinstance(node.args[0], ast.Constant)
        target = str(node.args[0].value) if constant else "bayesmc.<computed>"
        lazy_namespace = name == "bayesmc.__init__"
        if not lazy_namespace:
            yield "bayesmc" + target if target.startswith(".") else target


def _called(node: ast.Call) -> str:
    function = node.func
    return getattr(function, "attr", None) or getattr(function, "id", "")


def _between_modules(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """The graph with each target cut to the module that holds it, as far as it is one of ours."""
    modules = {name.removesuffix(".__init__"): name for name in graph}

    def module(target: str) -> str | None:
        while target and target not in modules:
            target = target.rpartition(".")[0]
        return modules.get(target)

    return {name: {module(t) for t in targets} - {None, name} for name, targets in graph.items()}


def _cycles(graph: dict[str, set[str]]) -> list[str]:
    """One line per module that imports itself through others, the package namespace apart."""
    found, finished = [], {"bayesmc.__init__"}

    def visit(name: str, path: list[str]) -> None:
        if name in path:
            found.append("cycle: " + " -> ".join([*path[path.index(name) :], name]))
        elif name not in finished:
            for target in sorted(graph[name]):
                visit(target, [*path, name])
            finished.add(name)

    for name in sorted(graph):
        visit(name, [])
    return found


def type_circles(sources: dict[str, str]) -> set[str]:
    """Modules that import each other if imports for types count, each circle in one line."""
    graph = {
        name: {target for target, *_ in _imports(name, text)} for name, text in sources.items()
    }
    between = _between_modules(graph)
    between.pop("bayesmc.__init__", None)
    beyond = {name: _reached(between, name) for name in between}
    circles = (
        sorted(other for other in beyond[name] if name in beyond[other])
        for name in between
        if name in beyond[name]
    )
    return {" ".join(name.removeprefix("bayesmc.") for name in circle) for circle in circles}


def _reached(graph: dict[str, set[str]], start: str) -> set[str]:
    found: set[str] = set()
    todo = [start]
    while todo:
        new = graph.get(todo.pop(), set()) - found
        found |= new
        todo += new
    return found


def package_sources() -> dict[str, str]:
    """Every module of the package: dotted name (``.__init__`` kept) -> source text."""
    return {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path.read_text("utf-8")
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def test_imports_point_down() -> None:
    assert violations(package_sources()) == []


@pytest.mark.parametrize(
    ("name", "source", "expected"),
    [
        ("network", "from bayesmc.engines.exact import Exact", "does not stand below"),
        ("network", "from .engines import exact", "does not stand below"),
        ("network", "from . import auto", "does not stand below"),
        ("shapes", "import bayesmc.errors", "does not stand below"),
        ("results", "if TYPE_CHECKING:\n    from bayesmc.dbn import X", "does not stand below"),
        ("network", "import bayesmc as bmc", "the package itself"),
        ("network", "def f():\n    from bayesmc.shapes import as_shape", "inside a function"),
        ("network", "class A:\n  def f(self):\n    import bayesmc.shapes", "inside a function"),
        ("auto", "m = importlib.import_module('.testing', 'bayesmc')", "does not stand below"),
        ("network", "import networkx as nx", "at module level"),
        ("network", "from scipy import stats", "at module level"),
        ("network", "from scipy.stats import norm", "at module level"),
        ("kernels", "try:\n  import numba.typed\nexcept ImportError:\n  pass", "at module level"),
        ("sklearn", "import pandas", "at module level"),
        ("vision", "from sklearn import tree", "at module level"),
        ("helpers", "", "no place in LAYERS"),
    ],
)  # fmt: skip
def test_planted_violation_is_found(name: str, source: str, expected: str) -> None:
    found = violations({f"bayesmc.{name}": source})
    assert len(found) == 1
    assert expected in found[0]


def test_planted_cycle_is_found() -> None:
    sources = {
        "bayesmc.engines.exact": "from bayesmc.engines.forward import f",
        "bayesmc.engines.forward": "from .exact import g",
    }
    assert violations(sources) == [
        "cycle: bayesmc.engines.exact -> bayesmc.engines.forward -> bayesmc.engines.exact"
    ]


def test_rightful_imports_pass() -> None:
    sources = {
        "bayesmc.__init__": "from bayesmc.auto import infer",
        "bayesmc.engines.exact": (
            "from __future__ import annotations\n"
            "import numpy as np\nimport scipy.special\nfrom bayesmc.network import BayesNet\n"
            "from .base import Engine\n"
            "if TYPE_CHECKING:\n    import networkx\n"
            "def f():\n    import networkx\n    from scipy import stats\n"
        ),
        "bayesmc.engines.base": "from ..errors import ModelError",
        "bayesmc.network": "from bayesmc import errors, shapes",
        "bayesmc.errors": "",
        "bayesmc.auto": "",
        "bayesmc.shapes": "",
    }
    assert violations(sources) == []


def test_circles_of_types_get_fewer() -> None:
    assert type_circles(package_sources()) <= TYPE_CIRCLES
    planted = {
        "bayesmc.kernels.a": "if TYPE_CHECKING:\n    from bayesmc.kernels.b import B",
        "bayesmc.kernels.b": "from bayesmc.kernels.a import A",
        "bayesmc.kernels.c": "from bayesmc.kernels.a import A",
    }
    assert type_circles(planted) == {"kernels.a kernels.b"}


def test_modules_and_functions_get_shorter() -> None:
    texts = sources()
    assert {length.what for length in long_modules(texts)} <= LONG_MODULES
    assert {length.what for length in long_functions(texts)} <= LONG_FUNCTIONS


@pytest.mark.parametrize("statement", ["import bayesmc", "from bayesmc import *"])
def test_import_loads_nothing_heavy(statement: str) -> None:
    modules = _loaded_by(statement)
    assert "bayesmc" in modules
    assert [name for name in modules if _is_heavy(name)] == []


def test_engines_load_when_first_named() -> None:
    rooms = {".".join(m.split(".")[:2]) for m in _loaded_by("import bayesmc")}
    assert rooms.isdisjoint(
        {"bayesmc.engines", "bayesmc.auto", "bayesmc.learning", "bayesmc.pmcmc"}
    )
    assert "bayesmc.engines.mcmc.gibbs" in _loaded_by("import bayesmc; bayesmc.Gibbs")
    assert "bayesmc.auto" in _loaded_by("import bayesmc; bayesmc.infer")


def test_names_that_load_later_are_those_of_type_checkers() -> None:
    tree = parsed((PACKAGE / "__init__.py").read_text())
    [checked] = [node for node in tree.body if isinstance(node, ast.If)]
    told = {
        alias.name: node.module
        for node in checked.body
        if isinstance(node, ast.ImportFrom) and node.module not in (None, "bayesmc")
        for alias in node.names
    }
    assert told == {name: f"bayesmc.{module}" for name, module in bayesmc._MODULES.items()}
    assert set(told) <= set(bayesmc.__all__) <= set(dir(bayesmc))
    assert all(getattr(bayesmc, name) is not None for name in bayesmc.__all__)
    with pytest.raises(AttributeError, match="no attribute 'KalmanFiler'"):
        bayesmc.KalmanFiler  # noqa: B018


def test_threads_may_name_engines_at_once() -> None:
    """Packages entered from two ends, each by a thread that waits for the other, were half loaded."""
    code = """
import sys, threading, bayesmc
sys.setswitchinterval(1e-5)
names = ("infer Gibbs ParticleFilter fit Fit map ParticleGibbs io ParticleBelief Exact "
         "KalmanFilter ExpectationPropagation LaplaceApproximation GridFilter engines MeanField").split()
barrier, failed = threading.Barrier(len(names)), []
def named(name):
    barrier.wait()
    try:
        getattr(bayesmc, name)
    except BaseException as error:
        failed.append(f"{name}: {error!r}")
threads = [threading.Thread(target=named, args=(n,)) for n in names]
for t in threads: t.start()
for t in threads: t.join()
print(failed)
"""
    for _ in range(3):
        found = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, text=True,
                               capture_output=True, check=True)  # fmt: skip
        assert found.stdout.strip() == "[]"


def _loaded_by(statement: str) -> set[str]:
    """Modules that a fresh interpreter has after a statement."""
    code = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, text=True,
                            capture_output=True, check=True)  # fmt: skip
    return set(json.loads(loaded.stdout))
