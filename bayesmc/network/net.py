"""``BayesNet``: where a user declares nodes. It keeps declarations; ``Model`` evaluates them.

It wraps a networkx graph (``net.graph``) and is not one, and it knows no engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import DuplicateNodeError, EvidenceError, UnknownNodeError
from bayesmc.network.declaring import (
    Declared,
    DeclaredPlates,
    Parents,
    check_parents,
    declared,
    declared_potential,
    declared_table,
    settled_sizes,
    unknown,
)
from bayesmc.network.evidence import read_inputs, read_question
from bayesmc.network.factor_graph import FactorGraph
from bayesmc.network.frames import unframed
from bayesmc.network.intervene import intervened
from bayesmc.network.joint import joint_log_prob, joint_sample
from bayesmc.network.model import Model, refuse_objects
from bayesmc.network.node import Declaration, Node, Potential, decorating, without_noise
from bayesmc.network.shown import net_html
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.shapes import as_shape

if TYPE_CHECKING:
    import networkx


class BayesNet(Declared):
    """A hybrid Bayes net: nodes whose conditional densities are plain functions of their parents.

    Parameters
    ----------
    name : str, optional
    plates : dict, optional
        Plate name -> size, a sequence of labels, or None (read from the data).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("sprinkler")
    >>> @net.node
    ... def rain():
    ...     return bmc.Bernoulli(0.2)
    >>> @net.node
    ... def wet(rain):
    ...     return bmc.Bernoulli(0.1 + 0.8 * rain)
    >>> posterior = bmc.infer(net, {"wet": 1}, engine=bmc.Exact())
    >>> posterior.probabilities("rain").round(4).tolist()
    [0.3077, 0.6923]

    References
    ----------
    Koller and Friedman, Probabilistic Graphical Models (2009), ch. 3 and 6 (plates).
    """

    def __init__(
        self,
        name: str | None = None,
        plates: Mapping[str, int | Sequence[Any] | None] | None = None,
    ) -> None:
        super().__init__(name, DeclaredPlates.read("BayesNet", name, plates))

    # ---- declaring --------------------------------------------------------------------------

    def node(
        self,
        function: Callable[..., Any] | None = None,
        *,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        name: str | None = None,
        parents: Parents = None,
        vectorize: bool = False,
        replace: bool = False,
    ) -> Any:
        """Declare a node by its conditional density, as a decorator; returns the function unchanged.

        The function's name is the node's name and its arguments are the parents; arguments with
        defaults are not parents. It returns a distribution, or an array (a deterministic node).

        Parameters
        ----------
        plates : str or sequence of str
            Plates the node is repeated over.
        states : sequence, optional
            Labels or numbers for the values of a finite distribution, in the order of its support.
        name : str, optional
            Node name, if not the function's.
        parents : list or dict, optional
            Node names in the order of the arguments, or argument name -> node name.
        vectorize : bool
            Call a function that does not broadcast once per element: slow.
        replace : bool
            Allow a name that is declared already.

        Raises
        ------
        DuplicateNodeError, PlateError, ModelError
        """
        options = {"vectorize": vectorize, "replace": replace}
        return decorating(function, name, self.add, (parents, plates, states), options)

    def add(
        self,
        name: str,
        cpd: Any,
        parents: Parents = None,
        plates: str | Sequence[str] = (),
        states: Sequence[Any] | None = None,
        *,
        vectorize: bool = False,
        replace: bool = False,
    ) -> None:
        """Declare a node by a distribution, a function or a table (the programmatic form of ``node``).

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("a", bmc.Bernoulli(0.3))
        >>> net.add("b", lambda a: bmc.Normal(a, 1.0))
        >>> net.add("c", [[0.9, 0.1], [0.2, 0.8]], parents=["a"], states=("low", "high"))
        >>> net["c"].parents
        ('a',)
        """
        own = self._plates.of(f"node {name!r}", plates)
        self._declare(declared(name, cpd, parents, own, states, vectorize), replace)

    def table(
        self,
        name: str,
        parents: Sequence[str] = (),
        probs: Any = None,
        states: Sequence[Any] | None = None,
        *,
        plates: str | Sequence[str] = (),
        replace: bool = False,
    ) -> None:
        """Declare a discrete node by its conditional probability table.

        Parameters
        ----------
        parents : sequence of str
            Discrete parents, in the order of the table's axes.
        probs : array_like, shape (card(parent_1), ..., card(parent_n), card(name))
            Every row sums to 1 (to 1e-6).
        states : sequence, optional
            Labels of the node's own values.

        Raises
        ------
        ParameterError
            A row that is not a probability vector, with its index.
        """
        own = self._plates.of(f"node {name!r}", plates)
        self._declare(declared_table(name, parents, probs, states, own), replace)

    def input(self, name: str, plates: str | Sequence[str] = (), event_shape: Any = ()) -> None:
        """Declare a known value, passed as ``inputs=`` to ``infer``, ``sample``, ``log_prob``."""
        plates = self._plates.of(f"node {name!r}", plates)
        self._declare(
            Declaration(name, "input", (), plates, event_shape=as_shape(event_shape)), False
        )

    def potential(
        self,
        name: Any = None,
        function: Any = ...,
        parents: Parents = None,
        plates: str | Sequence[str] = (),
    ) -> Any:
        """Add a log factor on named nodes: the joint density is multiplied by ``exp(function(...))``.

        Without ``plates`` the function sees plated nodes as foreign and reduces them (``x.sum("point")``);
        with them it acts element by element and the elements are summed. Without ``function`` it is a
        decorator, ``@net.potential``, ``@net.potential("name", plates="row")``.
        """
        if function is ... or name is None:
            own = name if isinstance(name, str) else None
            given = function if function is not ... else None if own else name
            return decorating(given, own, self.potential, (parents, plates), {}, "potential")
        within = self._plates.of(f"node {name!r}", plates)
        found = declared_potential(name, function, parents, within)
        if name in self._declarations or name in self._potentials:
            raise DuplicateNodeError(f"potential {name!r}: the name is declared already")
        self._potentials[name] = found
        self._changed()
        return None

    def do(self, mapping: Mapping[str, Any] | None = None, /, **values: Any) -> BayesNet:
        """A new net with those nodes cut from their parents and fixed (Pearl's intervention).

        Raises
        ------
        UnknownNodeError, EvidenceError
            A node the net lacks, or a value outside its support or shape.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("a", bmc.Bernoulli(0.3))
        >>> net.add("b", lambda a: bmc.Normal(2.0 * a, 1.0))
        >>> float(net.do(a=1).log_prob({"b": 2.0}).round(4))
        -0.9189
        """
        if mapping is not None and not isinstance(mapping, Mapping):
            raise EvidenceError(f"do({mapping!r}): give a dict, or name=value")
        other = self.copy()
        chosen = {**(mapping or {}), **values}
        other._declarations.update(intervened(self._store, self._plates.sizes, chosen))
        return other

    def with_links(self, links: Mapping[str, int]) -> BayesNet:
        """A copy in which some computed nodes have distributions without noise, so that they are observed."""
        other = self.copy()
        for name, rank in links.items():
            other._declarations[name] = without_noise(self._declarations[name], rank)
        return other

    # ---- asking -----------------------------------------------------------------------------

    def __getitem__(self, name: str) -> Node:
        if name not in self._declarations:
            raise UnknownNodeError(unknown(self._declarations, name))
        return self._store.probe(self._plates.sizes)[name].record()

    def __contains__(self, name: object) -> bool:
        return name in self._declarations

    def __iter__(self) -> Iterator[str]:
        return iter(self._declarations)

    def __len__(self) -> int:
        return len(self._declarations)

    def __repr__(self) -> str:
        return f"BayesNet({self.name!r}, {len(self)} nodes)"

    def _repr_html_(self) -> str:
        """As notebooks show it: the graph, and a table of nodes."""
        known, factors = self._declarations, self._potentials
        return net_html(repr(self), known, self.__getitem__, factors, self.plates)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes, as declared; ``net[name]`` describes one."""
        return tuple(self._declarations)

    @property
    def plates(self) -> dict[str, int | None]:
        """Plate name -> size (None where it is read from the data)."""
        return dict(self._plates.sizes)

    @property
    def declarations(self) -> dict[str, Declaration]:
        """Name -> what was declared, for code that makes other nets of this one."""
        return dict(self._declarations)

    @classmethod
    def of(
        cls,
        name: str | None,
        declarations: Mapping[str, Declaration],
        plates: DeclaredPlates,
    ) -> BayesNet:
        """A net of declarations that were read already."""
        net = cls(name)
        net._declarations = dict(declarations)
        net._plates = plates.copy()
        return net

    @property
    def potentials(self) -> dict[str, Potential]:
        """Name -> potential, with its ``parents`` and ``plates``."""
        return dict(self._potentials)

    @property
    def graph(self) -> networkx.DiGraph:
        """A networkx copy of the DAG, with ``plates`` and ``source`` on every node."""
        import networkx

        graph = networkx.DiGraph(name=self.name or "")
        for name, what in self._declarations.items():
            graph.add_node(name, plates=what.plates, source=what.source)
        for name, what in self._declarations.items():
            check_parents(self._declarations, name, what.parents)
            graph.add_edges_from((parent, name) for parent in what.parents)
        return graph

    def validate(self, inputs: Mapping[str, Any] | None = None) -> None:
        """Check the whole net: parents, plates, cycles, shapes, and that functions broadcast.

        Runs by itself on first use. Functions are evaluated on batch shapes (), (p,) and (q, p); each
        entry must equal the unbatched call, two equal calls must agree, and perturbing one element of a
        shared plate must move only that element.

        Raises
        ------
        ModelError
            Or one of its kinds, with the node's name, the fault and the fix.
        """
        if inputs is not None:
            self.model(inputs=inputs)
        else:
            self._store.validate(self._store.probe(self._plates.sizes))

    def log_prob(
        self, values: Mapping[str, Any], *, inputs: Mapping[str, Any] | None = None
    ) -> np.ndarray:
        """Joint log density of complete values, summed over nodes and plates; shape: their batch.

        Parameters
        ----------
        values : dict
            Stochastic node -> array ``(*batch, *plates, *event)`` or labels. Deterministic nodes may be
            left out; where one is given and differs from its function, the result is minus infinity.
        """
        if not isinstance(values, Mapping):
            raise EvidenceError(
                f"log_prob: values is a {type(values).__name__}; give a dict from node name to value"
            )
        trimmed = {n: self._unbatched(n, v) for n, v in values.items() if n in self._declarations}
        model = self.model(trimmed, inputs)
        for name in values:
            if name not in model.nodes:
                raise EvidenceError(f"log_prob: {unknown(self._declarations, name)}")
        return joint_log_prob(model, values, self._inputs(model.sizes, inputs))

    def sample(
        self,
        draws: int = 1,
        rng: Any = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
    ) -> dict[str, np.ndarray]:
        """Ancestral sampling: every node drawn given its parents, in topological order.

        Parameters
        ----------
        draws : int
        rng : seed, SeedSequence, Generator or None
        inputs : dict, optional
            Values of input nodes.
        plates : dict, optional
            Sizes of plates that are otherwise read from data.

        Returns
        -------
        dict of ndarray
            Name -> ``(draws, *plates, *event)``; labelled states compare with their labels.

        References
        ----------
        Bishop, Pattern Recognition and Machine Learning (2006), sec. 8.1.2.
        """
        if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < 0:
            raise ValueError(f"sample(draws={draws!r}): draws is a number of draws, 0 or more")
        model = self.model(None, inputs, plates)
        given = self._inputs(model.sizes, inputs)
        return joint_sample(model, int(draws), stream(seed_sequence(rng), Purpose.SAMPLE), given)

    def model(
        self,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
    ) -> Model:
        """The validated snapshot that engines run on, with plate sizes settled by the data."""
        settled = settled_sizes(self._plates, self._declarations, evidence, inputs, plates)
        model = self._store.model(settled, self._inputs(settled, inputs))
        refuse_objects(model)
        self._store.validate(model)
        return model

    def unframed(self, evidence: Any, inputs: Any = None) -> tuple[Any, Any]:
        """Evidence and inputs as dicts where they are data frames; others as they are (``network/frames``).

        Raises
        ------
        EvidenceError
        """
        if all(data is None or isinstance(data, Mapping) for data in (evidence, inputs)):
            return evidence, inputs
        plates = self._plates
        return unframed(self._declarations, plates.sizes, plates.labels, evidence, inputs)

    def to_factor_graph(
        self,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
    ) -> FactorGraph:
        """The net given evidence as variables and factors: one variable per hidden node.

        Every conditional density that a hidden node enters is a batch of factors, and so is every
        potential; scopes reach through deterministic nodes.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("rain", bmc.Bernoulli(0.2))
        >>> net.add("sprinkler", bmc.Bernoulli(0.4))
        >>> net.add("wet", lambda rain, sprinkler: bmc.Bernoulli(0.1 + 0.4 * (rain + sprinkler)))
        >>> graph = net.to_factor_graph({"wet": 1})
        >>> sorted(graph.markov_blanket("rain"))
        ['sprinkler']
        >>> graph.full_conditional("rain", {"sprinkler": 1}).probs.round(4).tolist()
        [0.6897, 0.3103]
        """
        return FactorGraph.of(*read_question(self, evidence, inputs))

    # ---- private ----------------------------------------------------------------------------

    def _declare(self, declaration: Declaration, replace_: bool) -> None:
        name = declaration.name
        self._refuse_name("node", name)
        if (name in self._declarations and not replace_) or name in self._potentials:
            raise DuplicateNodeError(
                f"node {name!r} is declared already; choose another name or pass replace=True"
            )
        self._declarations[name] = declaration
        self._changed()

    def _inputs(
        self, sizes: Mapping[str, int], inputs: Mapping[str, Any] | None
    ) -> dict[str, np.ndarray]:
        return read_inputs(self._declarations, sizes, inputs, self._plates.fitting(sizes))

    def _unbatched(self, name: str, value: Any) -> Any:
        """A stand-in with the value's plate axes in front, for reading plate sizes off it."""
        plates, sizes = self._declarations[name].plates, self._plates.sizes
        if all(sizes[p] is not None for p in plates):
            return None
        lead = np.ndim(value) - len(self._store.probe(sizes)[name].event_shape) - len(plates)
        return np.empty(np.shape(value)[lead:], dtype=bool) if lead >= 0 else None
