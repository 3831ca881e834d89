"""``FactorGraph``: variables, and log factors on them, without a direction.

It is declared directly, in batches of like factors, or made from a net and its evidence. Here stand the
declarations and what can be asked of the graph; engines see the same ``Model`` as of a net: a variable is a
node with a flat density, a batch of factors a potential.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import (
    DuplicateNodeError,
    EvidenceError,
    ModelError,
    PlateError,
    QueryError,
)
from bayesmc.network.declaring import Declared, DeclaredPlates
from bayesmc.network.evidence import Observed, read_evidence, read_inputs
from bayesmc.network.factor_batch import read_factor, variable_declaration
from bayesmc.network.factor_scope import factor_scopes, hidden_elements
from bayesmc.network.forward import refuse_parts
from bayesmc.network.full_conditional import full_conditional
from bayesmc.network.graph_view import FactorRecord, GraphView, VariableRecord
from bayesmc.network.model import Model


class FactorGraph(Declared):
    """Variables and log factors: a density that is a product, known up to its constant.

    Parameters
    ----------
    name : str, optional
    plates : dict, optional
        Plate name -> size, or a sequence of labels.

    Notes
    -----
    ``infer`` takes a factor graph wherever the engine needs no directed graph. Its
    ``log_marginal_likelihood`` is the log of the sum (integral) over all hidden variables of the product of
    all factors: log Z, when nothing is observed. Engines that draw forward refuse the variables of a graph
    that was declared directly, since nothing says how to draw them.

    References
    ----------
    Kschischang, Frey and Loeliger (2001); Koller and Friedman, Probabilistic Graphical Models (2009), ch. 4.

    Examples
    --------
    An Ising chain of five spins with a field on the first:

    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> graph = bmc.FactorGraph("ising", plates={"site": 5})
    >>> graph.variable("s", (-1, 1), plates="site")
    >>> left = np.arange(4)
    >>> graph.factor(lambda a, b: 0.5 * a * b, scope=("s", "s"), index=(left, left + 1))
    >>> graph.factor(lambda s: 1.0 * s, scope="s", index=[np.array([0])])
    >>> posterior = bmc.infer(graph, engine=bmc.Exact())
    >>> posterior.mean("s").round(4).tolist()
    [0.7616, 0.3519, 0.1626, 0.0752, 0.0347]
    >>> round(posterior.log_marginal_likelihood, 4)
    4.38
    >>> sorted(graph.markov_blanket("s", 1))
    [('s', (0,)), ('s', (2,))]
    """

    def __init__(
        self, name: str | None = None, plates: Mapping[str, int | Sequence[Any]] | None = None
    ) -> None:
        read = DeclaredPlates.read("FactorGraph", name, plates, open_sizes=False)
        super().__init__(name, read)
        self._kept_view: GraphView | None = None
        self._question: tuple[Any, Model, dict[str, Observed], dict[str, np.ndarray]] | None = None

    @classmethod
    def of(
        cls,
        net: Any,
        model: Model,
        observed: Mapping[str, Observed],
        inputs: Mapping[str, np.ndarray],
    ) -> FactorGraph:
        """The graph of a net given evidence, both read already; ``net.to_factor_graph`` is the way in."""
        parts = refuse_parts(observed, "a factor graph")
        if parts is not None:
            raise EvidenceError(parts)
        graph = cls(model.name)
        graph._plates = DeclaredPlates("FactorGraph", dict(model.sizes), dict(model.labels))
        graph._question = (net, model, dict(observed), dict(inputs))
        return graph

    # ---- declaring --------------------------------------------------------------------------

    def variable(
        self,
        name: str,
        support: Any,
        plates: str | Sequence[str] = (),
        *,
        event_shape: int | Sequence[int] = (),
    ) -> None:
        """Declare a variable.

        Parameters
        ----------
        name : str
        support : tuple, int, str or Support
            States of a finite variable (labels, which factors compare with ``==``, or numbers, which they
            receive as such); a number of states ``0..K-1``; or where else its values lie: ``"real"``,
            ``"positive"``, ``"unit interval"``, ``"nonnegative integer"``, ``"simplex"``, ..., or a
            Support, such as ``bmc.Uniform(2.0, 3.0).support``.
        plates : str or sequence of str
        event_shape : tuple of int
            Shape of one value of a vector or matrix variable.

        Raises
        ------
        DuplicateNodeError, PlateError, ModelError
            The name is taken, a plate is not the graph's, or the support is none.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> graph = bmc.FactorGraph(plates={"site": 3})
        >>> graph.variable("colour", ("red", "green", "blue"), plates="site")
        >>> graph.variable("w", "positive")
        >>> graph.variables["colour"].states, graph.variables["w"].support.describe()
        (('red', 'green', 'blue'), 'numbers > 0')
        """
        self._refuse_closed("variable")
        self._refuse_name("variable", name)
        own = self._plates.of(f"variable {name!r}", plates)
        self._declarations[name] = variable_declaration(name, support, own, event_shape)
        self._changed()

    def factor(
        self,
        log_potential: Any,
        scope: str | Sequence[str] | None = None,
        index: Any = None,
        name: str | None = None,
        *,
        plates: str | Sequence[str] | None = None,
    ) -> None:
        """Declare a factor, or a batch of like factors, by its log.

        Parameters
        ----------
        log_potential : callable or array_like
            A function of one array per entry of ``scope``. With ``index`` each has shape
            ``(*batch, rows, *event)`` and the result ``(*batch, rows)``, row by row; without, arrays come as
            to a node in ``plates``. A table of logs over finite variables has shape ``(K1, ..., Kn)``, the
            same for all factors of the batch, or ``(rows, K1, ..., Kn)`` (``(*plates, K1, ...)`` without
            ``index``). Minus infinity forbids.
        scope : str or sequence of str, optional
            The variables, declared before; a function's argument names when not given. With ``index``
            a variable may stand more than once.
        index : tuple, optional
            One factor per row. For each entry of the scope an integer array of one length, the position in
            the variable's plate; a tuple of arrays for a variable in several plates; None for one in none.
        name : str, optional
        plates : str or sequence of str, optional
            Without ``index``: one factor per element of these, by default of all plates of the scope.
            With fewer, variables arrive with foreign plates (``s.sum("site")``); ``()`` makes one factor
            of whole plates.

        Raises
        ------
        ModelError, UnknownNodeError, ShapeError, PlateError, DensityError
            The scope, the index or a table is wrong. What is wrong with a function's result is told on
            first use.

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> graph = bmc.FactorGraph(plates={"row": 2, "column": 3})
        >>> graph.variable("s", (-1, 1), plates=("row", "column"))
        >>> r, c = np.indices((2, 2)).reshape(2, -1)
        >>> graph.factor(lambda a, b: 0.3 * a * b, scope=("s", "s"), index=((r, c), (r, c + 1)))
        >>> graph.factor([[0.5, 0.0], [0.0, 0.5]], scope=("s", "s"),
        ...              index=((np.zeros(3, int), np.arange(3)), (np.ones(3, int), np.arange(3))))
        >>> [(factor.scope, factor.rows) for factor in graph.factors]
        [(('s',), 4), (('s',), 3)]
        """
        self._refuse_closed("factor")
        if name is None:
            count = len(self._potentials)
            while f"factor_{count}" in self:
                count += 1
            name = f"factor_{count}"
        self._refuse_name("factor", name)
        own = None if plates is None else self._plates.of(f"factor {name!r}", plates)
        self._potentials[name] = read_factor(
            name, log_potential, scope, index, own, self._declarations, self.plates
        )
        self._changed()

    # ---- asking -----------------------------------------------------------------------------

    def __iter__(self) -> Iterator[str]:
        return iter(self.variables)

    def __len__(self) -> int:
        return len(self.variables)

    def __repr__(self) -> str:
        if self._question is None:
            counts = len(self._declarations), len(self._potentials)
        else:
            counts = len(self.variables), len(self.factors)
        return f"FactorGraph({self.name!r}, {counts[0]} variables, {counts[1]} batches of factors)"

    @property
    def plates(self) -> dict[str, int]:
        """Plate name -> size."""
        return {p: n for p, n in self._plates.sizes.items() if n is not None}

    @property
    def variables(self) -> Mapping[str, VariableRecord]:
        """Name -> record of every hidden variable."""
        return MappingProxyType(self._view.variables())

    @property
    def factors(self) -> tuple[FactorRecord, ...]:
        """Every batch of factors that a hidden variable enters."""
        return self._view.factors()

    def validate(self) -> None:
        """Check that functions broadcast and act row by row; runs by itself on first use."""
        self.model()

    def markov_blanket(self, name: str, element: int | Sequence[int] | None = None) -> frozenset:
        """The variables that share a factor with one: given them, no other tells anything about it.

        Parameters
        ----------
        name : str
        element : int or tuple of int, optional
            Index in the variable's plates.

        Returns
        -------
        frozenset
            Names, the variable's own among them where its elements share factors; with an element pairs
            (name, index in its plates). A gather by a hidden index may take any element, and counts
            as all.

        Raises
        ------
        UnknownNodeError, QueryError
            No such hidden variable or element.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet(plates={"i": 2})
        >>> net.add("a", bmc.Normal(0.0, 1.0))
        >>> net.add("b", lambda a: bmc.Normal(a, 1.0), plates="i")
        >>> graph = net.to_factor_graph({"b": [0.3, float("nan")]})
        >>> sorted(graph.markov_blanket("a", ()))
        [('b', (1,))]
        """
        return self._view.markov_blanket(name, element)

    def log_prob(self, values: Mapping[str, Any]) -> np.ndarray:
        """Sum of all log factors at values of all hidden variables, evidence filled in.

        Parameters
        ----------
        values : dict
            Variable -> array ``(*batch, *plates, *event)`` or labels; of a partly observed one the whole
            plate, whose observed entries are not looked at.

        Returns
        -------
        ndarray, shape of the batch

        Raises
        ------
        EvidenceError
            A hidden variable has no value, or a value is not the variable's.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> graph = bmc.FactorGraph()
        >>> graph.variable("a", ("no", "yes"))
        >>> graph.factor([0.0, 1.5], scope="a")
        >>> graph.log_prob({"a": ["no", "yes", "yes"]}).tolist()
        [0.0, 1.5, 1.5]
        """
        view = self._view
        stored, batch = view.stored("log_prob", values)
        result = view.log_prob(stored)
        return np.array(np.broadcast_to(result, np.broadcast_shapes(np.shape(result), batch)))

    def full_conditional(
        self, name: str, state: Mapping[str, Any], element: int | Sequence[int] | None = None
    ) -> Distribution:
        """The distribution of one variable given all others: the factors on its blanket, normalised.

        Parameters
        ----------
        name : str
        state : dict
            Values of all other hidden variables, shape ``(*batch, *plates, *event)``; with ``element``
            the variable's own, too, for its other elements.
        element : int or tuple of int, optional
            Index in the variable's plates. Without it all elements at once, where no factor reads two.

        Returns
        -------
        Distribution
            Batch shape that of the state, followed by the plates unless an element is asked for. Of a finite
            variable a ``Categorical`` over its states, of a continuous number an ``InverseCdf`` (mean,
            var, cdf, draws), of vectors and of unbounded integers a ``Density`` that is not normalised.

        Raises
        ------
        EvidenceError
            The state is not complete, or holds what is none of the variables.
        QueryError
            Elements share factors, so an element must be chosen.
        ZeroProbabilityError
            No value is possible given the state.
        ParameterError
            A finite variable's possible state gives bad parameters, or a density cannot be integrated.

        References
        ----------
        Koller and Friedman (2009), sec. 12.3.3, eq. 12.23.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("mu", bmc.Normal(0.0, 1.0))
        >>> net.add("x", lambda mu: bmc.Normal(mu, 1.0))
        >>> conditional = net.to_factor_graph({"x": 2.0}).full_conditional("mu", {})
        >>> float(conditional.mean.round(6)), float(conditional.var.round(6))
        (1.0, 0.5)
        """
        view = self._view
        hidden = view.elements_of("full_conditional", name)
        if element is not None:
            flat = view.flat("full_conditional", name, element)
            return full_conditional(view, name, state, flat)
        plates = view.model[name].plates
        coupled = [s for s in view.scopes if name in s.reads and s.reads[name].couples(len(hidden))]
        if plates and coupled:
            raise QueryError(
                f"full_conditional({name!r}): elements of {name!r} share factor {coupled[0].name!r}, so they "
                f"are not independent given the rest; give element=, an index in plates {plates}"
            )
        if plates and view.model[name].domain is None and not hidden.all():
            raise QueryError(
                f"full_conditional({name!r}): some elements are observed; give element= of a hidden one"
            )
        return full_conditional(view, name, state, None)

    # ---- for engines ------------------------------------------------------------------------

    def model(
        self,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
        plates: Mapping[str, int] | None = None,
    ) -> Model:
        """The validated snapshot that engines run on; see ``BayesNet.model``."""
        changed = [p for p, n in (plates or {}).items() if self._plates.sizes.get(p) != n]
        if changed:
            raise PlateError(
                f"plates= gives {changed[0]!r}, but the plates of a factor graph have fixed sizes"
            )
        if self._question is not None:
            return self._question[1]
        read_inputs({}, self.plates, inputs, {})
        model = self._store.model(self.plates, {})
        self._store.validate(model)
        return model

    def question(
        self, evidence: Mapping[str, Any] | None, inputs: Mapping[str, Any] | None = None
    ) -> tuple[Any, Model, dict[str, Observed], dict[str, np.ndarray]]:
        """A snapshot, the model, and all that is known: the graph's own evidence and some more."""
        if self._question is None:
            model = self.model(None, inputs)
            return self.snapshot(), model, read_evidence(model, evidence), {}
        net, model, observed, given = self._question
        if inputs:
            raise EvidenceError(
                "inputs= were settled when the factor graph was made; give them to to_factor_graph"
            )
        more = read_evidence(model, evidence)
        for name in more:
            if name in observed:
                raise EvidenceError(
                    f"evidence on {name!r}, on which the factor graph has evidence already; give all of it "
                    "to to_factor_graph"
                )
        return net, model, {**observed, **more}, given

    def copy(self) -> FactorGraph:
        other = super().copy()
        other._question = self._question
        return other

    # ---- private ----------------------------------------------------------------------------

    def _changed(self) -> None:
        super()._changed()
        self._kept_view = None

    @property
    def _view(self) -> GraphView:
        if self._kept_view is None:
            _, model, observed, inputs = self.question(None)
            hidden = hidden_elements(model, observed)
            scopes = factor_scopes(model, observed, inputs)
            self._kept_view = GraphView(model, observed, inputs, hidden, scopes)
        return self._kept_view

    def _refuse_closed(self, what: str) -> None:
        if self._question is not None:
            raise ModelError(
                f"{what}: this factor graph was made from a net and takes no more; declare it in the net "
                "(net.potential for a factor)"
            )

    def _refuse_name(self, what: str, name: Any) -> None:
        super()._refuse_name(what, name)
        if name in self:
            raise DuplicateNodeError(f"{what} {name!r}: the name is declared already")
