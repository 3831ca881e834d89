"""Random nets, templates and factor graphs as the Python code that declares them.

The generators of this room write a line of code for every node and run it, so what they show is what they
did. The lines are kept beside the declarations, which copies and snapshots share. Nets that were declared in
another way are not turned into code: the source of a user's function is the user's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from bayesmc import distributions
from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import Distribution
from bayesmc.errors import ModelError
from bayesmc.network import BayesNet, FactorGraph
from bayesmc.plates import stack

#: what the lines may name
_NAMES = {
    "np": np,
    "bmc": SimpleNamespace(
        **{name: getattr(distributions, name) for name in distributions.__all__},
        stack=stack,
        BayesNet=BayesNet,
        DynamicBayesNet=DynamicBayesNet,
        FactorGraph=FactorGraph,
    ),
}
#: what a thing is called in its code
_VARIABLES = {BayesNet: "net", DynamicBayesNet: "dbn", FactorGraph: "graph"}
_LINES: WeakKeyDictionary[Any, str] = WeakKeyDictionary()


def as_code(thing: BayesNet | DynamicBayesNet | FactorGraph | Distribution) -> str:
    """The Python code that makes a random net, template, factor graph or distribution of this room.

    It starts at ``net = bmc.BayesNet(...)`` (``dbn``, ``graph``; a distribution is one expression) and needs
    ``import numpy as np`` and ``import bayesmc as bmc``. Names of nets are left out.

    Parameters
    ----------
    thing : BayesNet, DynamicBayesNet, FactorGraph or Distribution
        What `bayes_nets`, `dbns`, `factor_graphs`, `distributions` or their seeded forms made. Declared
        tables are turned into code whoever declared them.

    Returns
    -------
    str
        One line per node or factor.

    Raises
    ------
    ModelError
        It was made in another way, or holds a node that was.

    Examples
    --------
    >>> from bayesmc.testing import as_code, random_net
    >>> print(as_code(random_net(13, nodes=(2, 2), states=2)))
    net = bmc.BayesNet()
    net.add("v0", bmc.Binomial(1, logits=0.75))
    net.add("v1", lambda v0: bmc.Binomial(1, logits=0.625 + v0))
    """
    if isinstance(thing, Distribution):
        return _line(thing, "the distribution")
    if not isinstance(thing, tuple(_VARIABLES)):
        raise ModelError(
            f"as_code({thing!r}): give a net, a template, a factor graph or a distribution, not "
            f"{type(thing).__name__}"
        )
    kind = next(k for k in _VARIABLES if isinstance(thing, k))
    plates = f"plates={literal(dict(thing.plates))}" if thing.plates else ""
    declared = _declarations(thing).items()
    known = _table if isinstance(thing, BayesNet) else lambda declared: ""
    lines = [known(d) or _line(d, f"{name!r}") for name, d in declared]
    head = f"{_VARIABLES[kind]} = bmc.{kind.__name__}({plates})"
    return "\n".join([head, *lines])


# ---- for the generators -------------------------------------------------------------------------


def declare(thing: Any, call: str) -> None:
    """Run one call that declares a node or a factor, such as ``add("x", bmc.Normal(0.0, 1.0))``, and keep it.

    The call is a method of ``thing``, a net, a template or a factor graph.
    """
    before = _declarations(thing)
    line = f"{next(v for k, v in _VARIABLES.items() if isinstance(thing, k))}.{call}"
    exec(compile(line, "<random>", "exec"), {**_NAMES, line.partition(".")[0]: thing})
    for name, made in _declarations(thing).items():
        if before.get(name) is not made:
            _LINES[made] = line


def evaluate(expression: str) -> Any:
    """The distribution or array that an expression spells; of a distribution the spelling is kept."""
    found = eval(compile(expression, "<random>", "eval"), dict(_NAMES))
    if isinstance(found, Distribution):
        _LINES[found] = expression
    return found


def array(values: Any) -> str:
    """Numbers as an array that broadcasts, ``np.array([0.5, 1.0])``, or as one literal."""
    plain = np.asarray(values).tolist()
    return f"np.array({plain!r})" if isinstance(plain, list) else repr(plain)


def literal(value: Any) -> str:
    """``repr`` with double quotes, as the rest of the code has them."""
    text = repr(value)
    return text if '"' in text or "\\" in text else text.replace("'", '"')


def function(arguments: Sequence[str], body: str) -> str:
    """A function of nodes; without any, what it would return."""
    return f"lambda {', '.join(arguments)}: {body}" if arguments else body


def call(method: str, *arguments: str, **options: Any) -> str:
    """A call of a method; of the options those that say something, as literals."""
    said = [
        f"{name}={literal(value)}" for name, value in options.items() if value not in (None, ())
    ]
    return f"{method}({', '.join([*arguments, *said])})"


def over(plates: Sequence[str]) -> Any:
    """Plates as a person gives them: the name of a single one."""
    return plates[0] if len(plates) == 1 else tuple(plates)


def affine(offset: Any, terms: Iterable[tuple[float, str]]) -> str:
    """``0.5 + 2.0 * a - b`` of an offset and (weight, expression); an offset of zero is not written."""
    written = "" if np.ndim(offset) == 0 and offset == 0 else array(offset)
    for weight, expression in terms:
        size = "" if abs(weight) == 1 and written else f"{abs(weight)!r} * "
        sign = "-" if weight < 0 else "+"
        if written:
            written += f" {sign} {size}{expression}"
        else:
            written = f"{'-' * (weight < 0)}{size}{expression}"
    return written or "0.0"


def softmax(score: str, slopes: Sequence[float]) -> str:
    """A finite distribution whose logits are a number times slopes."""
    try:
        logits = repr([slope * float(score) for slope in slopes])
    except ValueError:  # no number, but code of one
        is_call = score.startswith("np.array(") and score.index(")") == len(score) - 1
        factor = score if is_call else f"({score})"
        logits = f"bmc.stack([s * {factor} for s in {list(slopes)!r}])"
    return f"bmc.Categorical(logits={logits})"


# ---- private ------------------------------------------------------------------------------------


def _declarations(thing: Any) -> Mapping[str, Any]:
    """What was declared, by name, in order."""
    if isinstance(thing, DynamicBayesNet):
        return thing.template.later
    if isinstance(thing, BayesNet):
        return {**thing.declarations, **thing.potentials}
    return {**thing._declarations, **thing._potentials}  # without a property of its own


def _table(declared: Any) -> str:
    """The line of a net's table, which says all of itself; "" for anything else or what is kept."""
    if declared in _LINES or getattr(declared, "source", "") != "table":
        return ""
    states, plates = declared.states, over(declared.plates)
    texts = map(literal, (declared.name, list(declared.parents), declared.probs.tolist()))
    return "net." + call("table", *texts, states=states, plates=plates)


def _line(made: Any, what: str) -> str:
    if made not in _LINES:
        raise ModelError(
            f"as_code: {what} was not made by the generators of bayesmc.testing, so its code is not "
            "known; show the code that you wrote"
        )
    return _LINES[made]
