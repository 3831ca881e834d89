"""``DynamicBayesNet``: one slice of time, declared once, and what a slice takes from the one before.

Every node has a declaration for *later* slices, whose function may name ``<node>_prev`` and ``t``, and with
``initial=`` another for slice 0. What both compile to is in ``slices``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.dbn.frames import unframed_series
from bayesmc.dbn.given import is_plain
from bayesmc.dbn.series import unrolled
from bayesmc.dbn.slices import PREVIOUS, TIME, Slices, SliceStore, Template
from bayesmc.dbn.two_slices import template_html
from bayesmc.dbn.unroll import sampled, unroll
from bayesmc.distributions import Distribution
from bayesmc.errors import (
    DuplicateNodeError,
    ModelError,
    ParameterError,
    UnknownNodeError,
    did_you_mean,
)
from bayesmc.network import BayesNet, Node
from bayesmc.network.declaring import DeclaredPlates, Parents
from bayesmc.network.node import Declaration, decorating, without_noise
from bayesmc.randomness import Purpose, seed_sequence, stream

if TYPE_CHECKING:
    import networkx


class DynamicBayesNet:
    """A template for time: the same slice over and over, each given the one before.

    Parameters
    ----------
    name : str, optional
    plates : dict, optional
        Plate name -> size, list of labels, or None (known from the data), as for a ``BayesNet``.

    Notes
    -----
    A function's arguments are nodes of its own slice, ``<node>_prev`` for the value in the slice before,
    ``t`` for the index of the slice (a whole number from 0, or an array of them that broadcasts, so write
    ``np.where``, not ``if``), inputs (``u`` and ``u_prev``) and static nodes, which have one value for all
    time. Whatever reads the slice before needs ``initial=``, its density in slice 0.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet("random walk")
    >>> @dbn.node(initial=bmc.Normal(0.0, 1.0))
    ... def x(x_prev):
    ...     return bmc.Normal(x_prev, 0.5)
    >>> @dbn.node
    ... def y(x):
    ...     return bmc.Normal(x, 1.0)
    >>> net = dbn.unroll(3)
    >>> list(net), net["x[2]"].parents
    (['x[0]', 'y[0]', 'x[1]', 'y[1]', 'x[2]', 'y[2]'], ('x[1]',))
    >>> evidence = dbn.unrolled_evidence({"y": [0.3, np.nan, 1.2]})
    >>> posterior = bmc.infer(net, evidence, engine=bmc.Exact())
    >>> float(posterior.mean("x[2]").round(4))
    0.675

    References
    ----------
    Dean and Kanazawa (1989), A model for reasoning about persistence and causation; Koller and Friedman
    (2009), sec. 6.2.2 (2-TBN).
    """

    def __init__(
        self,
        name: str | None = None,
        plates: Mapping[str, int | Sequence[Any] | None] | None = None,
    ) -> None:
        declared = DeclaredPlates.read("DynamicBayesNet", name, plates)
        self._store = SliceStore(Template(name, {}, {}, (), (), declared))

    # ---- declaring --------------------------------------------------------------------------

    def node(
        self,
        function: Callable[..., Any] | None = None,
        *,
        initial: Any = None,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        name: str | None = None,
        parents: Parents = None,
        vectorize: bool = False,
        replace: bool = False,
    ) -> Any:
        """Declare a node by its conditional density, as a decorator; returns the function unchanged.

        Parameters
        ----------
        initial : Distribution or callable, optional
            Density in slice 0, given nodes of the same slice, inputs and ``t``; needed where the function
            reads ``<node>_prev``.
        plates, states, name, parents, vectorize, replace
            As for ``BayesNet.node``; ``parents=`` may list ``"x_prev"`` and ``"t"``.

        Raises
        ------
        DuplicateNodeError, PlateError, ModelError
        """

        options: dict[str, Any] = {"initial": initial, "vectorize": vectorize, "replace": replace}
        return decorating(function, name, self.add, (parents, plates, states), options)

    def add(
        self,
        name: str,
        cpd: Any,
        parents: Parents = None,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        *,
        initial: Any = None,
        vectorize: bool = False,
        replace: bool = False,
    ) -> None:
        """Declare a node by a distribution, a function or a table of probabilities.

        Parameters
        ----------
        cpd, parents, states, plates, vectorize, replace
            As for ``BayesNet.add``.
        initial : optional
            Density in slice 0: a distribution, a function, or probabilities where ``cpd`` is a table.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 1.0), initial=bmc.Normal(0.0, 2.0))
        >>> dbn["x"].parents
        ('x_prev',)
        """
        self._check_name(name, replace)
        options: dict[str, Any] = {"vectorize": vectorize}
        later = self._read(name, BayesNet.add, cpd, parents, plates, states, **options)
        self._declare(name, later, self._initial(name, initial, plates, states, vectorize))

    def table(
        self,
        name: str,
        parents: Sequence[str] = (),
        probs: Any = None,
        states: Sequence[Any] | None = None,
        *,
        initial: Any = None,
        plates: str | Sequence[str] = (),
        replace: bool = False,
    ) -> None:
        """Declare a discrete node by its conditional probability table.

        Parameters
        ----------
        parents, probs, states, plates, replace
            As for ``BayesNet.table``; a parent may be ``"<node>_prev"``.
        initial : array_like, Distribution or callable, optional
            In slice 0: probabilities of the states, or a density.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet("umbrella world")
        >>> dbn.table("rain", ["rain_prev"], [[0.7, 0.3], [0.3, 0.7]], ("no", "yes"), initial=[0.5, 0.5])
        >>> dbn.table("umbrella", ["rain"], [[0.8, 0.2], [0.1, 0.9]], ("no", "yes"))
        >>> dbn["rain"].states
        ('no', 'yes')
        """
        self._check_name(name, replace)
        later = self._read(name, BayesNet.table, parents, probs, states, plates=plates)
        self._declare(name, later, self._initial(name, initial, plates, states, False))

    def input(self, name: str, plates: str | Sequence[str] = (), event_shape: Any = ()) -> None:
        """Declare a value known in every slice, passed as ``inputs={name: array}``, time first.

        Functions read it as ``name`` and, of the slice before, as ``<name>_prev``.
        """
        self._check_name(name, False)
        later = self._read(name, BayesNet.input, plates, event_shape)
        self._declare(name, later, inputs=(*self.inputs, name))

    def static(
        self,
        function: Callable[..., Any] | None = None,
        *,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        name: str | None = None,
        parents: Parents = None,
        vectorize: bool = False,
    ) -> Any:
        """Declare a node without time, as a decorator: a parameter with one value for all slices.

        Its parents are static nodes. Unrolled it keeps its name; filters want it observed.
        """

        rest, options = (parents, plates, states), {"vectorize": vectorize}
        return decorating(function, name, self.add_static, rest, options)

    def add_static(
        self,
        name: str,
        cpd: Any,
        parents: Parents = None,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        *,
        vectorize: bool = False,
    ) -> None:
        """Declare a static node by a distribution, a function or a table."""
        self._check_name(name, False)
        later = self._read(name, BayesNet.add, cpd, parents, plates, states, vectorize=vectorize)
        self._declare(name, later, static=(*self.static_nodes, name))

    def copy(self) -> DynamicBayesNet:
        """An independent template with the same declarations."""
        other = DynamicBayesNet()
        other._store = self._store  # declarations make a new one
        return other

    def with_links(self, links: Mapping[str, int]) -> DynamicBayesNet:
        """A copy in which some computed nodes have distributions without noise, so that they are observed."""

        def linked(declared: Mapping[str, Declaration]) -> dict[str, Declaration]:
            return {n: without_noise(d, links[n]) if n in links else d for n, d in declared.items()}

        other, own = self.copy(), self.template
        other._store = SliceStore(replace(own, later=linked(own.later), first=linked(own.first)))
        return other

    # ---- asking -----------------------------------------------------------------------------

    @property
    def name(self) -> str | None:
        return self.template.name

    @property
    def plates(self) -> dict[str, int | None]:
        """Plate name -> size; None where the data will tell."""
        return dict(self.template.plates.sizes)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.template.inputs

    @property
    def static_nodes(self) -> tuple[str, ...]:
        """Names of the nodes without time."""
        return self.template.static

    @property
    def template(self) -> Template:
        """The declarations as they stand, for those who compile or unroll them."""
        return self._store.template

    @property
    def graph(self) -> networkx.DiGraph:
        """A networkx copy of the two-slice template: nodes ``x_prev`` and ``x``; see ``plotting``.

        Every node has ``slice`` (``"prev"``, ``"now"``, or ``"static"``) and ``source``.
        """
        return self.template.graph()

    def validate(self) -> None:
        """Check both slices: parents, cycles, shapes, domains, and that functions broadcast.

        Raises
        ------
        ModelError and its subclasses, with the node's name
        """
        self._store.validate(self._store.probe(self.plates))

    def slices(self, sizes: Mapping[str, int], inputs: Mapping[str, np.ndarray]) -> Slices:
        """The compiled slices that engines run on, validated; ``inputs`` are those of two slices in a row."""
        found = self._store.slices(sizes, inputs)
        self._store.validate(found)
        return found

    def unroll(self, steps: int, inputs: Mapping[str, Any] | None = None) -> BayesNet:
        """A plain net of so many slices: nodes ``"x[0]"``, ``"x[1]"``, ..., on which every engine runs.

        Parameters
        ----------
        steps : int
        inputs : dict, optional
            Their values, time first, which become constants; else the net has inputs ``"u[0]"``, ....

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev, t: bmc.Normal(x_prev + t, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> float(bmc.infer(dbn.unroll(4), engine=bmc.Exact()).mean("x[3]"))
        6.0
        """
        if inputs is not None:
            inputs = self.unframed(None, inputs)[1]
        return unroll(self.template, steps, inputs)

    def unrolled_evidence(self, observations: Any) -> dict[str, Any]:
        """Evidence for the unrolled net, ``{"y[0]": row 0, ...}``; missing rows are left out."""
        return unrolled(self.template, self.unframed(observations)[0])

    def unframed(self, observations: Any, inputs: Any = None) -> tuple[Any, Any, np.ndarray | None]:
        """Observations and inputs as dicts where they are data frames, and the times of their rows.

        Raises
        ------
        EvidenceError
        """
        if is_plain(observations) and is_plain(inputs):
            return observations, inputs, None
        return unframed_series(self.template, observations, inputs)

    def sample(
        self,
        steps: int,
        draws: int = 1,
        *,
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
        rng: Any = None,
    ) -> dict[str, np.ndarray]:
        """Draws of whole trajectories.

        Returns
        -------
        dict of ndarray
            Name -> ``(draws, steps, *plates, *event)``; static nodes have no axis for time.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.sample(5, draws=3, rng=0)["x"].shape
        (3, 5)
        """
        chance = stream(seed_sequence(rng), Purpose.SAMPLE)
        return sampled(self, steps, draws, inputs, plates, chance)

    def __getitem__(self, name: str) -> Node:
        if name not in self:
            raise UnknownNodeError(
                f"the template has no node {name!r}{did_you_mean(name, self)}; its nodes are {list(self)}"
            )
        return self._store.record(name, self.plates)

    def __contains__(self, name: object) -> bool:
        return name in self.template.later

    def __iter__(self) -> Iterator[str]:
        return iter(self.template.later)

    def __len__(self) -> int:
        return len(self.template.later)

    def __repr__(self) -> str:
        return f"DynamicBayesNet({self.name!r}, {len(self)} nodes)"

    def _repr_html_(self) -> str:
        """As notebooks show it: two slices as a graph, and a table of nodes."""
        return template_html(self)

    # ---- private ----------------------------------------------------------------------------

    def _declare(
        self, name: str, later: Declaration, first: Declaration | None = None, **named: Any
    ) -> None:
        """Take in a node: for later slices, and for slice 0 if it has another declaration there."""
        own = self.template
        zero = {n: d for n, d in own.first.items() if n != name}
        zero |= {} if first is None else {name: first}
        self._store = SliceStore(
            replace(own, later={**own.later, name: later}, first=zero, **named)
        )

    def _initial(
        self,
        name: str,
        initial: Any,
        plates: str | Sequence[str],
        states: Sequence[Any] | None,
        vectorize: bool,
    ) -> Declaration | None:
        """The declaration of slice 0, if there is one."""
        if initial is None:
            return None
        if isinstance(initial, (list, tuple, np.ndarray)):
            try:
                return self._read(name, BayesNet.table, (), initial, states, plates=plates)
            except (ModelError, ParameterError) as error:
                error.add_note(
                    "initial= is the density of slice 0: a list holds the probabilities of a finite node "
                    "that reads no other; for others give a distribution (Normal(0.0, 1.0)) or a function"
                )
                raise
        if not isinstance(initial, Distribution) and not callable(initial):
            is_number = isinstance(initial, (int, float, np.number))
            what = (
                f"={initial!r} is a number"
                if is_number
                else f"= is of type {type(initial).__name__}"
            )
            raise ModelError(
                f"node {name!r}: initial{what}; give the density of slice 0, such as Normal(0.0, 1.0), a "
                "function that returns one, or a list of probabilities; of a computed node a function of "
                f"what it is, such as lambda: {initial if is_number else 1.0}"
            )
        vectorize = vectorize and callable(initial)
        return self._read(name, BayesNet.add, initial, None, plates, states, vectorize=vectorize)

    def _read(self, name: str, add: Callable[..., Any], *given: Any, **options: Any) -> Declaration:
        """A declaration as a plain net reads it."""
        net = BayesNet.of(None, {}, self.template.plates)
        add(net, name, *given, **options)
        return net.declarations[name]

    def _check_name(self, name: Any, replace: bool) -> None:
        if not isinstance(name, str) or not name:
            raise ModelError(f"a node's name is a non-empty string, not {name!r}")
        if name == TIME:
            raise ModelError(
                f"node {TIME!r}: {TIME!r} is the index of the slice; choose another name"
            )
        if name.endswith(PREVIOUS):
            raise ModelError(
                f"node {name!r}: names that end in {PREVIOUS!r} are those of the slice before; choose another"
            )
        if name in self and not replace:
            raise DuplicateNodeError(
                f"node {name!r} is declared already; choose another name or pass replace=True"
            )
