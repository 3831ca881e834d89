"""Answers to many questions: a sequence of posteriors that answers for all of them at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, overload

import numpy as np

from bayesmc.errors import ShapeError
from bayesmc.results.posterior import Posterior


class Posteriors(Sequence[Posterior]):
    """Posteriors of one net given many evidence sets, in their order.

    What is asked of it is answered for every set, stacked along a first axis. One posterior is
    ``posteriors[k]``; ``None`` where a run was stopped before.

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

    def __init__(self, found: Sequence[Posterior | None]) -> None:
        self._found = list(found)

    def __len__(self) -> int:
        return len(self._found)

    @overload
    def __getitem__(self, index: int) -> Posterior: ...
    @overload
    def __getitem__(self, index: slice) -> Posteriors: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return Posteriors([self._one(k) for k in range(*index.indices(len(self)))])
        return self._one(range(len(self))[index])

    def __iter__(self) -> Iterator[Posterior]:
        return (self[k] for k in range(len(self)))

    @property
    def done(self) -> np.ndarray:
        """Whether each question was answered; all, unless the run was stopped, shape (sets,)."""
        return np.array([found is not None for found in self._found], dtype=bool)

    @property
    def log_marginal_likelihood(self) -> np.ndarray:
        """Log probability (density) of each evidence, shape (sets,); NaN where an engine gives none."""
        found = [one.log_marginal_likelihood for one in self._all("log_marginal_likelihood")]
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

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} evidence sets)"

    # ---- private -------------------------------------------------------------------------------

    def _one(self, k: int) -> Posterior | None:
        return self._found[k]

    def _all(self, what: str) -> Iterator[Posterior]:
        for k in range(len(self)):
            one = self._one(k)
            if one is None:
                raise ValueError(
                    f"{what}: the run was stopped before evidence set {k}; ask the posteriors that are "
                    "`done`, or call infer_many with the other sets"
                )
            yield one

    def _stacked(self, what: str, ask: Callable[[Posterior], Any]) -> np.ndarray:
        answers = [np.asarray(ask(one)) for one in self._all(what)]
        shapes = {answer.shape for answer in answers}
        if len(shapes) > 1:
            raise ShapeError(
                f"{what}: answers have shapes {sorted(shapes)}, since plates are of other sizes in some "
                "evidence sets; ask posteriors[k] one by one"
            )
        return np.stack(answers) if answers else np.zeros(0)
