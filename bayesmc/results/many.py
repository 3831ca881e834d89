"""Answers to many questions: a sequence of posteriors that answers for all of them at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np

from bayesmc.errors import ShapeError
from bayesmc.network import Problem
from bayesmc.network.fingerprint import fingerprint
from bayesmc.results.dataframes import posteriors_frame
from bayesmc.results.posterior import Posterior
from bayesmc.results.saving import save
from bayesmc.results.shown import posteriors_html


class Posteriors(Sequence[Posterior]):
    """Posteriors of one net given many evidence sets, in their order.

    What is asked of it is answered for every set, stacked along a first axis. One posterior is
    ``posteriors[k]``; ``None`` where a run was stopped before, and of evidence that is impossible.

    Attributes
    ----------
    impossible : dict
        With ``infer_many(on_impossible="nan")``: position of a set whose evidence has probability zero ->
        why. All that is asked of it is NaN, but for the log evidence where that is known to be -inf.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2))
    >>> net.add("wet", lambda rain: bmc.Bernoulli(0.1 + 0.8 * rain))
    >>> posteriors = bmc.infer_many(net, [{"wet": 0}, {"wet": 1}])
    >>> posteriors.mean("rain").round(4).tolist(), posteriors[1].mean("rain").round(4).item()
    ([0.027, 0.6923], 0.6923)
    """

    def __init__(
        self, found: Sequence[Posterior | None], impossible: Mapping[int, str] | None = None
    ) -> None:
        self._found = list(found)
        self.impossible = dict(impossible or {})

    @classmethod
    def of(cls, found: Sequence[Posterior | None]) -> Posteriors:
        """Some posteriors; those that are not there count as impossible, so that all others are told."""
        return Posteriors(found, {k: "" for k, one in enumerate(found) if one is None})

    def __len__(self) -> int:
        return len(self._found)

    @overload
    def __getitem__(self, index: int) -> Posterior: ...
    @overload
    def __getitem__(self, index: slice) -> Posteriors: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            chosen = range(*index.indices(len(self)))
            wrong = {j: self.impossible[k] for j, k in enumerate(chosen) if k in self.impossible}
            return Posteriors([self._one(k) for k in chosen], wrong)
        return self._one(range(len(self))[index])

    def __iter__(self) -> Iterator[Posterior]:
        return (self[k] for k in range(len(self)))

    @property
    def done(self) -> np.ndarray:
        """Whether there is a posterior of each set, shape (sets,).

        All, unless the run was stopped, but for sets that are ``impossible``.
        """
        return np.array([found is not None for found in self._found], dtype=bool)

    @property
    def log_marginal_likelihood(self) -> np.ndarray:
        """Log probability (density) of each evidence, shape (sets,).

        NaN where an engine gives none; of evidence that is impossible -inf where all nodes are finite.
        """
        found: list[Any] = []
        for one in self._all("log_marginal_likelihood"):
            found.append(None if one is None else one.log_marginal_likelihood)
        return np.array([np.nan if log is None else log for log in found], dtype=float)

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states, or joint tables, shape ``(sets, *plates, states, ...)``."""
        return self._stacked("probabilities", lambda one: one.probabilities(*names))

    def mean(self, name: str) -> np.ndarray:
        """Posterior means, shape ``(sets, *plates, *event)``."""
        return self._stacked("mean", lambda one: one.mean(name))

    def var(self, name: str) -> np.ndarray:
        """Posterior variances, shape ``(sets, *plates, *event)``."""
        return self._stacked("var", lambda one: one.var(name))

    def std(self, name: str) -> np.ndarray:
        """Posterior standard deviations, shape ``(sets, *plates, *event)``."""
        return np.sqrt(self.var(name))

    def expectation(self, function: Callable[..., Any], **options: Any) -> np.ndarray:
        """Posterior expectations of a function, as ``Posterior.expectation`` has them, sets first."""
        return self._stacked("expectation", lambda one: one.expectation(function, **options))

    def mcse(self, what: Any, **options: Any) -> np.ndarray:
        """Monte Carlo standard errors, sets first."""
        return self._stacked("mcse", lambda one: one.mcse(what, **options))

    @property
    def model(self) -> Any:
        """The model of the first set that was answered; None without any."""
        one = self._some()
        return None if one is None else one.model

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about."""
        one = self._some()
        return () if one is None else tuple(one.names)

    def to_dataframe(self, names: str | Sequence[str] | None = None) -> Any:
        """Answers as a pandas ``DataFrame``: a row for each evidence set (index ``evidence_set``).

        Columns have levels ``node``, ``element`` (labels of plates, places in a vector) and ``statistic``:
        ``mean`` and ``sd``, or of finite nodes the probability of each state. Draws of one set are those of
        ``posteriors[k].to_dataframe()``.

        Parameters
        ----------
        names : str or sequence of str, optional
            Nodes; by default those that some set leaves open.

        Raises
        ------
        MissingExtraError
            Without pandas (the extra ``pandas``).
        UnknownNodeError, UnsupportedError, ShapeError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
        >>> net.table("wet", ["rain"], [[0.9, 0.1], [0.1, 0.9]], states=("no", "yes"))
        >>> frame = bmc.infer_many(net, [{"wet": "yes"}, {}]).to_dataframe()  # doctest: +SKIP
        >>> frame["rain", "", "yes"].round(3).tolist()  # doctest: +SKIP
        [0.692, 0.2]
        """
        return posteriors_frame(self, names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all of them to one file that ``bmc.load`` reads, and ArviZ and xarray, too.

        It is NetCDF-4 (the extra ``netcdf``). Means, variances and probabilities of all sets stand under
        ``answers``, along ``evidence_set``; what each posterior's own file would hold (draws, what was
        observed) under ``set0``, ``set1``, ... The file takes the place of another one at once or not at
        all. Functions stay out.

        Raises
        ------
        MissingExtraError
        CheckpointError
            The disk is full, or may not be written.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("die", bmc.DiscreteUniform(1, 6))
        >>> bmc.infer_many(net, [{}, {"die": 2}]).save("dice.nc")  # doctest: +SKIP
        >>> bmc.load("dice.nc").mean("die").tolist()  # doctest: +SKIP
        [3.5, 2.0]
        """
        save(self, path, self._said())

    def kept(self) -> Sequence[Posterior | None]:
        """Posteriors, each of which ``bind`` takes a problem for; one where all are about the same."""
        return tuple(self._found)

    def bind(self, problems: Sequence[Problem | None]) -> None:
        """Answer with the functions of problems again, which a file carries none of; one for each set."""
        for one, problem in zip(self._found, problems, strict=True):
            if one is not None and problem is not None:
                one.bind(problem)

    def _repr_html_(self) -> str:
        """As notebooks show it: a line for each evidence set."""
        return posteriors_html(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} evidence sets)"

    # ---- private -------------------------------------------------------------------------------

    def _one(self, k: int) -> Posterior | None:
        return self._found[k]

    def _some(self) -> Posterior | None:
        """One that was answered, if there is any."""
        return next((one for one in self._found if one is not None), None)

    def _each(self) -> Iterator[tuple[int, Posterior]]:
        """Posteriors that are kept one by one, with their positions."""
        return ((k, one) for k, one in enumerate(self._found) if one is not None)

    def _free(self) -> list[str]:
        """Nodes that some set leaves open."""
        ones = [one for _, one in self._each()]
        return [n for n in self.names if any(one._is_free(n) for one in ones)]

    def _said(self) -> dict[str, Any]:
        """What a file says of the nets besides: their fingerprints, and whose are whose."""
        prints: dict[int, int] = {}
        found: list[Any] = []
        whose: list[int | None] = []
        for _, one in self._each():
            if one.problem is not None and id(one.problem.model) not in prints:
                prints[id(one.problem.model)] = len(found)
                found.append(fingerprint(one.problem.model))
            whose.append(None if one.problem is None else prints[id(one.problem.model)])
        return {"fingerprints": found, "whose": whose}

    def _all(self, what: str) -> Iterator[Posterior | None]:
        """All posteriors; None of impossible evidence."""
        for k in range(len(self)):
            one = self._one(k)
            if one is None and k not in self.impossible:
                raise ValueError(
                    f"{what}: the run was stopped before evidence set {k}; ask the posteriors that are "
                    "`done`, or call infer_many with the other sets"
                )
            yield one

    def _stacked(self, what: str, ask: Callable[[Posterior], Any]) -> np.ndarray:
        answers = [None if one is None else np.asarray(ask(one)) for one in self._all(what)]
        known = [answer for answer in answers if answer is not None]
        shapes = {answer.shape for answer in known}
        if len(shapes) > 1:
            raise ShapeError(
                f"{what}: answers have shapes {sorted(shapes)}, since plates are of other sizes in some "
                "evidence sets; ask posteriors[k] one by one"
            )
        if not known:
            if answers:
                raise ValueError(f"{what}: all evidence sets are impossible; `impossible` says why")
            return np.zeros(0)
        if len(known) == len(answers):
            return np.stack(known)
        nan = np.full(known[0].shape, np.nan)
        return np.stack([nan if answer is None else answer for answer in answers])
