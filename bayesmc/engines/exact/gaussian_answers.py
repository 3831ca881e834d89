"""What an exact posterior says of continuous nodes: the mixtures of Gaussians that they are.

Values of a node are put together from its elements: hidden ones from their moments, observed ones as seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from bayesmc.distributions import Mixture, MvNormal, Normal
from bayesmc.errors import BudgetError, UnsupportedError
from bayesmc.factors.moments import Components, Moments
from bayesmc.gaussian import try_cholesky
from bayesmc.network import Model, Observed
from bayesmc.results.laws import Laws, NormalLaws, mixture_laws
from bayesmc.structure import Variable, is_hidden

#: below this a standard deviation is none: what is computed without noise
_NO_SPREAD = 1e-150
#: share of a component's variance, given those before it, that is nothing but rounding
_ROUNDING = 1e-13


class GaussianAnswers:
    """Means, covariances, mixtures and draws of continuous nodes.

    Parameters
    ----------
    model : Model
    observed : mapping
        For nodes of which only some elements are hidden.
    moments : Moments
    """

    def __init__(self, model: Model, observed: Mapping[str, Observed], moments: Moments) -> None:
        self.model, self._moments = model, moments
        hidden = {n for n in model.nodes if is_hidden(model[n], observed)}
        self._nodes = hidden | {block[0] for block in moments.scopes}
        self._seen = {
            name: seen.value
            for name, seen in observed.items()
            if seen.mask is not None and model[name].domain is None
        }

    def holds(self, name: str) -> bool:
        """Whether a node is one of those answered here."""
        return name in self._nodes or name in self._seen

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean, shape ``(*plates, *event)``."""
        parts = [self._own(name, e)[0] for e in self._elements(name)]
        return np.reshape(np.array(parts), self.model[name].value_shape)

    def var(self, name: str) -> np.ndarray:
        """Posterior variance, shape ``(*plates, *event)``."""
        parts = [np.diagonal(self._own(name, e)[1]) for e in self._elements(name)]
        return np.reshape(np.array(parts), self.model[name].value_shape)

    def laws(self, name: str) -> Laws:
        """The distribution of each number of a node by itself."""
        node = self.model[name]
        mean, std = self.mean(name), np.sqrt(np.maximum(self.var(name), 0.0))
        everywhere = tuple(slice(None) for _ in node.plates)
        parts = [self.distribution(name, (*everywhere, *at)) for at in np.ndindex(node.event_shape)]
        if all(part.weights.shape[-1] == 1 for part in parts) or not np.any(std):
            return NormalLaws(mean, std)
        if not node.event_shape:
            return mixture_laws(parts[0])
        most = max(part.weights.shape[-1] for part in parts)
        stacked = [
            np.stack([_filled(take(part), most) for part in parts], axis=-2)
            for take in (_weights_of, _locs_of, _scales_of)
        ]
        weights, locs, scales = (a.reshape(*node.value_shape, most) for a in stacked)
        return mixture_laws(Mixture(weights, Normal(locs, np.where(scales > 0, scales, 1.0))))

    def components(
        self,
        names: Sequence[str],
        extra: Sequence[Any] = (),
        spread: bool = True,
        only: Mapping[str, int] | None = None,
    ) -> tuple[Components, dict[str, list[int]]]:
        """The joint mixture of all hidden elements of some nodes (of each ``only`` one, where that is said).

        With it come each node's columns in the blocks' means, -1 for what is observed or left out.
        """
        blocks: list[Variable] = []
        columns: dict[str, list[int]] = {}
        width = 0
        for name in names:
            columns[name] = []
            for e in self._elements(name):
                d = self._size(name)
                left_out = only is not None and only[name] != e
                if left_out or (name, e) not in self._moments.scopes:
                    columns[name] += [-1] * d
                    continue
                blocks.append((name, e))
                columns[name] += range(width, width + d)
                width += d
        with _naming(*names):
            return self._moments.components(blocks, extra, spread), columns

    def values(self, name: str, means: np.ndarray, columns: Sequence[int]) -> np.ndarray:
        """Values of a node in every component, ``(components, *plates, *event)``, from the blocks' means."""
        picked = np.array(columns, dtype=int)
        shape = self.model[name].value_shape
        if not means.shape[-1]:
            full = np.zeros((len(means), len(picked)))
        else:
            full = means[:, np.maximum(picked, 0)]
        if name in self._seen:
            full = np.where(picked < 0, self._seen[name].reshape(-1), full)
        return full.reshape((len(means), *shape))

    def distribution(self, name: str, index: tuple[Any, ...] = ()) -> Mixture:
        """The posterior of a node, or of the part at an index, as a mixture of Gaussians.

        Plates that the index leaves are batch axes; where elements have mixtures of different lengths, the
        shorter are filled up with components of weight zero.

        Raises
        ------
        UnsupportedError
            Of a whole vector with a singular covariance.
        """
        node = self.model[name]
        plates, event = index[: len(node.plates)], index[len(node.plates) :]
        elements = np.arange(math.prod(node.plate_shape)).reshape(node.plate_shape)[plates]
        parts = [self._part(name, int(e)) for e in np.ravel(elements)]
        most = max((len(w) for w, _, _ in parts), default=1)
        weights = np.zeros((len(parts), most))
        d = self._size(name)
        means = np.zeros((len(parts), most, d))
        covs = np.broadcast_to(np.eye(d), (len(parts), most, d, d)).copy()
        for k, (w, mean, cov) in enumerate(parts):
            weights[k, : len(w)], means[k, : len(w)], covs[k, : len(w)] = w, mean, cov
        lead = np.shape(elements)
        weights = weights.reshape((*lead, most))
        shape = (*lead, most, *node.event_shape)
        if event or not node.event_shape:
            spread = np.sqrt(np.maximum(np.diagonal(covs, axis1=-2, axis2=-1), _NO_SPREAD**2))
            at = (..., *event)
            return Mixture(weights, Normal(means.reshape(shape)[at], spread.reshape(shape)[at]))
        if _is_singular(covs):
            raise UnsupportedError(
                f"marginal({name!r}): the covariance of the whole vector is singular (an element is seen, or "
                "components that follow from each other), so it has no density; ask for one component, "
                f"marginal({name!r}, index)"
            )
        return Mixture(weights, MvNormal(means.reshape(shape), covs.reshape((*shape, d))))

    def draw(
        self, rng: np.random.Generator, codes: Mapping[Any, np.ndarray], draws: int
    ) -> dict[str, np.ndarray]:
        """Draws of the hidden nodes given draws of the finite ones, ``(draws, *plates, *event)``."""
        blocks = self._moments.sample(rng, codes, draws)
        found = {}
        for name, node in self.model.nodes.items():
            if not node.is_stochastic or not self.holds(name):
                continue
            seen = self._seen.get(name)
            values = np.empty((draws, math.prod(node.plate_shape), self._size(name)))
            for e in self._elements(name):
                if (name, e) in blocks:
                    values[:, e] = blocks[(name, e)]
                else:
                    assert seen is not None
                    values[:, e] = seen.reshape(values.shape[1:])[e]
            found[name] = values.reshape((draws, *node.value_shape))
        return found

    # ---- private -----------------------------------------------------------------------------

    def _elements(self, name: str) -> range:
        return range(math.prod(self.model[name].plate_shape))

    def _size(self, name: str) -> int:
        return math.prod(self.model[name].event_shape)

    def _own(self, name: str, e: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean and covariance of one element."""
        if (name, e) in self._moments.scopes:
            with _naming(name):
                return self._moments.moments((name, e))
        return self._fixed(name, e), np.zeros((self._size(name), self._size(name)))

    def _part(self, name: str, e: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights, means and covariances of one element's components."""
        if (name, e) not in self._moments.scopes:
            mean, cov = self._own(name, e)
            return np.ones(1), mean[None], cov[None]
        with _naming(name):
            found = self._moments.components([(name, e)])
        return found.weights, found.mean, found.cov

    def _fixed(self, name: str, e: int) -> np.ndarray:
        return self._seen[name].reshape(-1, self._size(name))[e]


@contextmanager
def _naming(*names: str) -> Iterator[None]:
    """Say of which nodes a mixture is too large."""
    try:
        yield
    except BudgetError as error:
        whose = "joint posterior" if len(names) > 1 else "posterior"
        raise BudgetError(
            f"{', '.join(map(repr, names))}: of the {whose}, {error}", error.bytes
        ) from None


def _is_singular(covs: np.ndarray) -> bool:
    """Whether some covariance is singular up to rounding."""
    tril, bad = try_cholesky(covs)
    pivots = np.linalg.diagonal(tril) ** 2
    return bad is not None or bool((pivots <= _ROUNDING * np.linalg.diagonal(covs)).any())


def _weights_of(mixture: Mixture) -> np.ndarray:
    return mixture.weights


def _locs_of(mixture: Mixture) -> np.ndarray:
    return np.broadcast_to(mixture.components.loc, mixture.weights.shape)


def _scales_of(mixture: Mixture) -> np.ndarray:
    return np.broadcast_to(mixture.components.scale, mixture.weights.shape)


def _filled(values: np.ndarray, most: int) -> np.ndarray:
    """With zeros up to so many components."""
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, most - values.shape[-1])])
