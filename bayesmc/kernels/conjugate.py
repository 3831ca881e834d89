"""Conjugate nodes: draws from a full conditional in closed form.

A node is conjugate where its prior and every child that it enters are pairs of the table, proved by
tracing the children's functions. Flat and truncated priors stay in closed form; where rounding leaves
none (an interval far out in a tail, a flat prior and too few data for a proper posterior) the elements
concerned take a slice step instead, which leaves the same distribution invariant.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), ch. 2-3, 11.3; Plummer, JAGS user manual, 4.3.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError, UnsupportedError
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.conjugate_children import Partner
from bayesmc.kernels.conjugate_kinds import KINDS, Bounds, Kind, Naturals, split_prior
from bayesmc.kernels.conjugate_labels import summed, with_sums
from bayesmc.kernels.conjugate_like import partners_of
from bayesmc.kernels.conjugate_matching import Match, match_of
from bayesmc.kernels.conjugate_pairs import PAIRS, Pair
from bayesmc.kernels.conjugate_picks import is_picked
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.kernels.slice import slice_move
from bayesmc.kernels.vector_draws import InverseWishartDraw, NormalDraw
from bayesmc.kernels.verify import check_ratio
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_children import with_like_children
from bayesmc.structure.target import Values


class Conjugate(Kernel):
    """Draws a node from its full conditional, a distribution of its prior's family.

    Parameters
    ----------
    blanket : Blanket
    kind : Kind
        The family of the full conditional.
    partners : sequence of Partner
        The children.
    power : float
        For a scale, the power that is Gamma.
    debug : bool
        Check every draw against the model's densities.
    """

    label = "conjugate"

    def __init__(
        self,
        blanket: Blanket,
        kind: Kind,
        partners: Sequence[Partner],
        power: float,
        debug: bool = False,
    ) -> None:
        self.blanket, self.kind, self.partners = blanket, kind, tuple(partners)
        self.power, self.debug = power, debug
        self.names = (blanket.name,)
        words = dict.fromkeys(
            f"{p.pair.words}{' where it is picked' if p.is_picked else ''}" for p in partners
        )
        self.match = f"{_prior_words(blanket)} with {', '.join(words)}"
        self._constant = not _prior_is_hidden(blanket)
        self._kept: dict[int, tuple[Naturals, Bounds | None]] = {}

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket = self.blanket
        values, derived = with_sums(values, self._sums)
        if self._whole is not None and not self.debug:
            try:
                new = self._whole(values, rng, len(values[blanket.name]))
            except np.linalg.LinAlgError as error:
                raise self._degenerate(error) from error
            if math.isfinite(np.add.reduce(new, axis=None)):  # else the posterior says why
                return {blanket.name: new, **derived}, memory
        state = values
        for part, members in enumerate(blanket.classes):
            if part:  # what follows from the classes before
                state = dict(state)
                blanket.target.refresh(state, self.names)
            try:
                new = self._moved(state, part, members, rng)
            except np.linalg.LinAlgError as error:
                raise self._degenerate(error) from error
            state = {**state, blanket.name: blanket.moved(state, new, members)}
        return {blanket.name: state[blanket.name], **derived}, memory

    def full_conditional(self, values: Values, part: int = 0) -> Distribution:
        """The distribution of a class's elements given all others.

        Returns
        -------
        Distribution
            Batch broadcasts to ``(chains, *plates)``, or ``(chains, members)`` for a class of elements.
        """
        naturals, bounds = self._naturals(values, part)
        return self.kind.posterior(naturals, bounds, self.power)

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _sums(self) -> list[LabelSums]:
        """Sums by label that the children are known by."""
        ways = [p.counts if p.way is None else p.way.sums for p in self.partners]
        return list(dict.fromkeys(w for w in ways if w is not None))

    @cached_property
    def _whole(self) -> NormalDraw | InverseWishartDraw | None:
        """Natural parameters and draw as one program, where all children are summed by labels or fixed."""
        make: Any = {"mean": NormalDraw, "covariance": InverseWishartDraw}.get(self.kind.name)
        classes = self.blanket.classes
        if make is None or not self._constant or len(classes) > 1 or classes[0] is not None:
            return None
        prior, bounds = self._prior({**self.blanket.target.known}, 0, None)
        added = [p.expressions if bounds is None else None for p in self.partners]
        totals = summed(prior, added, self.blanket.node.plate_shape, self.kind.event_ndims)
        return None if totals is None else make(*totals)

    def _moved(
        self, values: Values, part: int, members: np.ndarray | None, rng: np.random.Generator
    ) -> np.ndarray:
        """New values of one class of elements."""
        now = self.blanket.current(values, members)
        shape = now.shape[: now.ndim - len(self.blanket.event_shape)]
        naturals, bounds = self._naturals(values, part)
        drawn = self.kind.draw(naturals, bounds, rng, shape)
        if drawn is not None and not self.debug:
            return drawn
        posterior = self.kind.posterior(naturals, bounds, self.power)
        if drawn is None:
            drawn = self._drawn(values, members, posterior, bounds, now, rng)
        if self.debug:
            self._check(values, members, posterior, now, drawn)
        return drawn

    def _naturals(self, values: Values, part: int) -> tuple[Naturals, Bounds | None]:
        """Natural parameters of the full conditional: the prior's and what children add."""
        members = self.blanket.classes[part]
        prior, bounds = self._prior(values, part, members)
        totals = list(prior)
        for partner in self.partners:
            for i, added in enumerate(partner.natural(values, members)):
                totals[i] = totals[i] + added
        return tuple(totals), bounds

    def _prior(
        self, values: Values, part: int, members: np.ndarray | None
    ) -> tuple[Naturals, Bounds | None]:
        if part in self._kept:
            return self._kept[part]
        assert self.blanket.own is not None
        base, bounds = split_prior(self.blanket.own.distribution(values)[0])
        if base is None:
            assert bounds is not None
            naturals = self.kind.flat(*(np.asarray(b, dtype=float) for b in bounds))
        else:
            naturals = self.kind.natural(base)
        naturals = tuple(
            self._picked(a, members, n)
            for a, n in zip(naturals, self.kind.event_ndims, strict=True)
        )
        if bounds is not None:
            bounds = (self._picked(bounds[0], members), self._picked(bounds[1], members))
        if self._constant:
            self._kept[part] = naturals, bounds
        return naturals, bounds

    def _picked(self, array: Any, members: np.ndarray | None, event_ndim: int = 0) -> np.ndarray:
        """A prior's parameter with one axis for chains and the plates, or the members of a class."""
        array = np.asarray(array, dtype=float)
        node = self.blanket.node
        ndim = 1 + len(node.plates) + event_ndim
        array = array.reshape((1,) * (ndim - array.ndim) + array.shape)
        if members is None:
            return array
        event = array.shape[array.ndim - event_ndim :]
        full = np.broadcast_to(array, (len(array), *node.plate_shape, *event))
        return full.reshape((len(array), self.blanket.size, *event))[:, members]

    def _drawn(
        self,
        values: Values,
        members: np.ndarray | None,
        posterior: Distribution,
        bounds: Bounds | None,
        now: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        shape = now.shape[: now.ndim - len(self.blanket.event_shape)]
        new = posterior.sample_to(rng, shape)
        if posterior.invalid is None:
            return new
        if self.blanket.event_shape:
            raise self._degenerate(posterior.problem)
        lost = np.broadcast_to(posterior.invalid, shape)
        return np.where(lost, self._sliced(values, members, bounds, now, rng), new)

    def _degenerate(self, problem: Exception | None) -> DensityError:
        return DensityError(
            f"node {self.blanket.name!r}: its full conditional ({self.match}) is degenerate to rounding: "
            f"{problem}; rescale its children's coefficients, or give it a tighter prior"
        )

    def _sliced(
        self,
        values: Values,
        members: np.ndarray | None,
        bounds: Bounds | None,
        now: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """One slice step of every element."""
        low, high = (-np.inf, np.inf) if bounds is None else bounds
        if self.kind.name == "scale":
            low = np.maximum(low, 0.0)
        elif self.kind.name == "share":
            low, high = np.maximum(low, 0.0), np.minimum(high, 1.0)
        span = np.asarray(high) - np.asarray(low)
        width = np.where(np.isfinite(span), span, np.maximum(np.abs(now), 1e-3))

        def log_density(tried: np.ndarray) -> np.ndarray:
            return np.broadcast_to(self._density.log_density(values, tried, members), tried.shape)

        return slice_move(log_density, now, width, rng, low, high)

    @cached_property
    def _density(self) -> Blanket:  # what slice steps ask
        return with_like_children(self.blanket)

    # ---- verified conjugacy --------------------------------------------------------------------

    def _check(
        self,
        values: Values,
        members: np.ndarray | None,
        posterior: Distribution,
        now: np.ndarray,
        new: np.ndarray,
    ) -> None:
        """Refuse a draw that would not always be accepted as a proposal."""
        logs, sizes, proposal = [], [], []
        for value in (now, new):
            log, size = self._log_and_size(values, value, members)
            logs.append(log)
            q = posterior.log_prob(value)
            proposal.append(q)
            sizes.append(size + np.abs(q))
        # rounding puts a draw on the edge of the support, where neither density is a number
        fine = np.isfinite(proposal[0]) & np.isfinite(proposal[1])
        if posterior.invalid is not None:
            fine = fine & ~posterior.invalid
        ratios = [np.where(fine, b - a, 0.0) for a, b in (logs, proposal)]
        check_ratio(self.blanket.name, self.match, ratios[0], ratios[1], sizes[0] + sizes[1])

    def _log_and_size(
        self, values: Values, value: np.ndarray, members: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log full conditional, and the sum of the sizes of all its terms."""
        blanket = self.blanket
        state = blanket.placed(values, value, members)
        total = blanket.own_log(state, members)
        size = np.abs(total)
        for child in blanket.children:
            dist, batch, keys = blanket.distribution(child, state)
            log = child.term.log_of(dist, batch, state[child.term.name])
            collect = child.relation.collect
            total = total + collect(log, child.term.shape, keys, members)
            size = size + collect(np.abs(log), child.term.shape, keys, members)
        return total, size


def conjugate_kernel(
    blanket: Blanket, debug: bool = False, pairs: Sequence[Pair] = PAIRS
) -> Conjugate | str:
    """The conjugate kernel of a node, or in words why there is none.

    Parameters
    ----------
    blanket : Blanket
    debug : bool
        Check every draw against the model's densities (slow).
    pairs : sequence of Pair
        The conjugate table.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate import conjugate_kernel
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("shape", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(10 * rate))
    >>> net.add("time", lambda shape: bmc.Gamma(shape, 1.0))
    >>> target = target_of(pose(net, {"count": 3, "time": 0.5}))
    >>> conjugate_kernel(Blanket(target, "rate")).match
    'Gamma with Poisson rate'
    >>> conjugate_kernel(Blanket(target, "shape"))
    "it enters the concentration of Gamma 'time'"
    """
    if blanket.own is None:
        return "it has no prior density of its own"
    if blanket.node.is_discrete or blanket.node.domain is not None:
        return "it is discrete"
    prior = _probed_prior(blanket)
    if prior is None:
        return "its prior cannot be evaluated"
    base, bounds = split_prior(prior)
    kinds = [k for k in KINDS if (k.takes_flat if base is None else isinstance(base, k.priors))]
    if not kinds:
        return f"a {type(prior if base is None else base).__name__} prior has no conjugate pair"
    best, reason = (-1, False), ""
    for kind in kinds:
        matches, found = _matched(blanket, kind, base, bounds, pairs)
        if not isinstance(found, str):
            partners = partners_of(blanket, kind, matches)
            unlike = (p.unless_picked for p in partners if p.unless_picked and not is_picked(p))
            found = next(unlike, found)
            if not isinstance(found, str):
                return Conjugate(blanket, kind, partners, found, debug)
        told = (len(matches), "makes no conjugate pair" not in found)
        if told > best:  # of a flat prior's kinds, the one that fits most children says most
            best, reason = told, found
    return reason


def full_conditional(blanket: Blanket, values: Values, part: int = 0) -> Distribution:
    """The full conditional of a conjugate node in a state.

    Parameters
    ----------
    values : dict
        Stored values of all nodes, hidden ones ``(chains, *plates, *event)``.
    part : int
        Which of ``blanket.classes``.

    Returns
    -------
    Distribution
        Batch broadcasts to ``(chains, *plates)``, or to ``(chains, members)`` of a class of elements.

    Raises
    ------
    UnsupportedError
        The node is not conjugate; the message says why.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate import full_conditional
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"toss": 4})
    >>> net.add("p", bmc.Beta(1.0, 1.0))
    >>> net.add("heads", lambda p: bmc.Bernoulli(p), plates="toss")
    >>> target = target_of(pose(net, {"heads": [1, 0, 1, 1]}))
    >>> found = full_conditional(Blanket(target, "p"), {**target.known, "p": np.array([0.5])})
    >>> found.concentration1.tolist(), found.concentration0.tolist()
    ([4.0], [2.0])
    """
    kernel = conjugate_kernel(blanket)
    if isinstance(kernel, str):
        raise UnsupportedError(
            f"full_conditional: node {blanket.name!r} is not conjugate: {kernel}; evaluate "
            "blanket.log_density on a grid instead"
        )
    return kernel.full_conditional(values, part)


# ---- private ------------------------------------------------------------------------------------


def _matched(
    blanket: Blanket,
    kind: Kind,
    base: Distribution | None,
    bounds: Bounds | None,
    pairs: Sequence[Pair],
) -> tuple[list[Match], float | str]:
    """The pairs of children, and the power that is Gamma (1 if none is) or a reason of refusal."""
    matches: list[Match] = []
    if base is None:
        low, high = (np.asarray(b, dtype=float) for b in bounds)  # type: ignore[union-attr]
        if np.isnan(kind.flat(low, high)[0]).any():
            return matches, "its flat prior reaches beyond what the parameter allows"
    power = kind.power(base)
    for child in blanket.children:
        match = match_of(blanket, child, kind, pairs)
        if match is None:
            continue
        if isinstance(match, str):
            return matches, match
        if kind.name == "scale":
            wanted = match.pair.exponent * match.power
            if power is not None and wanted != power:
                prior = f"a {type(base).__name__} prior" if base is not None else "another child"
                return matches, (
                    f"the density of child {child.term.name!r} has the power {wanted:g} of it in its "
                    f"exponential, and {prior} the power {power:g}: no conjugate pair"
                )
            power = wanted
        matches.append(match)
    if not matches:
        return matches, "no child varies with it"
    return matches, 1.0 if power is None else power


def _probed_prior(blanket: Blanket) -> Distribution | None:
    """The prior at some reachable values of its parents."""
    assert blanket.own is not None
    target = blanket.target
    try:
        with marking_invalid(), np.errstate(all="ignore"):
            return blanket.own.distribution(ChainMap(target.known, target.model.probe))[0]
    except Exception:
        return None


def _prior_words(blanket: Blanket) -> str:
    prior = _probed_prior(blanket)
    assert prior is not None
    base, bounds = split_prior(prior)
    if base is None:
        return "Uniform"
    return f"{'truncated ' if bounds is not None else ''}{type(base).__name__}"


def _prior_is_hidden(blanket: Blanket) -> bool:
    """Whether the prior's parameters change from sweep to sweep."""
    assert blanket.own is not None
    return bool(blanket.target.hidden_above(blanket.own))
