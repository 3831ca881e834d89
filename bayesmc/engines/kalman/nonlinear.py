"""``ExtendedKalmanFilter`` and ``UnscentedKalmanFilter``: every slice linearised where the belief is.

They differ in the rule alone: derivatives at the mean, or sigma points around it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Asked, pass_slices
from bayesmc.engines.kalman.data import SeriesData
from bayesmc.engines.kalman.filter import GaussianFilter, KalmanFilter
from bayesmc.engines.kalman.levels import Level, Made, Plan, expected_slice, why_not_matched
from bayesmc.engines.kalman.means import Innovations
from bayesmc.engines.kalman.passes import Ahead, Expected, Filtered, RowTaker, Taken, Turns
from bayesmc.engines.kalman.posterior import GaussianSeries, filter_answers
from bayesmc.engines.kalman.slices import Layout, Moments
from bayesmc.errors import ParameterError, UnsupportedError
from bayesmc.linalg.square_root import multiplied, turned

#: balances the rounding of a central difference against its curvature
_STEP = float(np.finfo(float).eps ** (1 / 3))


class NonlinearFilter(GaussianFilter):
    """Base of the filters that make every slice linear where the belief is."""

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """See ``levels.Rule``."""
        raise NotImplementedError

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        if asked.what == "most_likely" and (why := self._no_mode(problem)) is not None:
            return why
        return super().unable(problem, asked)

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        """Smoothed means, of templates proved linear-Gaussian only.

        Elsewhere they are no mode: of y = x^2 + noise they lie between two of them.

        Raises
        ------
        UnsupportedError
            The template is not linear-Gaussian.
        """
        why = self._no_mode(problem)
        if why is not None:
            raise UnsupportedError(why)
        return super().most_likely(problem, seed, progress)

    def refused_row(self, layout: Layout, values: Mapping[str, np.ndarray]) -> str | None:
        """See ``passes.Family``."""
        why = why_not_matched(layout)
        return None if why is None else f"{why}; use ParticleFilter"

    def expected(self, ahead: Ahead) -> Expected:
        """See ``passes.Family``."""
        layout = ahead.layout
        plan = ahead.memory(("plan", layout), lambda: Plan(layout, ahead.values))
        return Expected(*expected_slice(ahead, self.made_linear, plan))

    def _no_mode(self, problem: SeriesProblem) -> str | None:
        """Why smoothed means are not the most likely trajectory, or None."""
        refused = KalmanFilter().refusal(problem)
        if refused is None:
            return None
        why = refused.removeprefix("KalmanFilter: ").partition("; use ")[0]
        return (
            f"most_likely: the smoothed means of {type(self).__name__} are the most likely trajectory of "
            f"linear-Gaussian templates only, and {why}; use GridFilter(grid={{...}}), which finds the mode "
            "over the points of a grid"
        )

    def _own_refusal(self, problem: SeriesProblem, data: SeriesData) -> str | None:
        for layout in data.layouts:
            why = self.refused_row(layout, {})
            if why is not None:
                return why
        return None

    def _forward(
        self,
        problem: SeriesProblem,
        data: SeriesData,
        smoothing: bool,
        advance: Callable[[int], None],
    ) -> Filtered:
        """Row by row; every row has its own layout, which is put into the one of the series."""
        steps, whole = data.steps, data.layouts[0]
        n, c, shape = whole.n, whole.carried, (steps, *whole.lead)
        turns = None
        if smoothing:
            square = (*shape, c, c)
            turns = Turns(np.zeros(square), np.zeros(square), np.zeros((*shape, c)))
        found = Filtered(
            np.empty((*shape, n)), np.zeros((*shape, n, n)), np.arange(steps), np.empty(shape), turns,
            Innovations(whole, data.series.observed, steps),
        )  # fmt: skip
        taker = RowTaker(self, problem.slices, data.static)
        before: Taken | None = None

        def move(k: int) -> None:
            nonlocal before
            taken = taker.take(data.series.row(k), before, smoothing)
            _write(found, k, whole, taken)
            if turns is not None and before is not None:
                _write_turn(turns, k, whole, before.layout, taken)
            before = taken

        def so_far(k: int) -> GaussianSeries:
            return filter_answers(self, problem, data, found.first(k))

        pass_slices(data.series.start, steps, move, so_far, partial(advance, 1))
        return found


@dataclass(frozen=True)
class ExtendedKalmanFilter(NonlinearFilter):
    """Approximate beliefs about nonlinear templates: means become their tangents at the belief's mean.

    Hidden nodes, and observed ones that depend on them, may have any smooth means and scales. Families other
    than Normal and MvNormal are matched by their mean and variance, vectors of other families by ``mean`` and
    ``cov_root``, any square root of their covariance. Numbers on a circle (``VonMises``, ``WrappedNormal``,
    headings of poses) count angles the short way round: innovations and differences are wrapped to
    [-pi, pi), and their variance is ``-2 log R`` with R the mean resultant length.

    Counts that are missing in a row are answered by mean and variance where nothing with a density reads
    them. What is computed from hidden nodes and takes no continuous values (truth values, whole numbers,
    states) is not answered for; functions of the same slice read it as it is.

    Derivatives are those of the declared functions' expressions (forward mode), to rounding; at a kink they
    are the mean of both sides. Central differences, all in one call, where a function cannot be followed
    (``vectorize=True``, SciPy functions that are no ufuncs, ...) or jumps just there. Where functions are
    affine the results are those of ``KalmanFilter``.

    Notes
    -----
    The log marginal likelihood is that of the linearised model. Where the belief is wide beside the curvature
    of a mean, the filter can be far off and sure of itself; hold it against a ``ParticleFilter``.
    ``most_likely`` is answered for linear-Gaussian templates only, where smoothed means are the mode.

    References
    ----------
    Jazwinski (1970), Stochastic Processes and Filtering Theory, ch. 8; Särkkä and Svensson (2023), Bayesian
    Filtering and Smoothing, 2nd ed., ch. 7; Griewank and Walther (2008), Evaluating Derivatives, 2nd ed.,
    sec. 3.1, for the forward mode.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import ExtendedKalmanFilter
    >>> dbn = bmc.DynamicBayesNet("pendulum")
    >>> dbn.add("v", lambda v_prev, a_prev: bmc.Normal(v_prev - 0.1 * np.sin(a_prev), 0.05),
    ...         initial=bmc.Normal(0.0, 0.1))
    >>> dbn.add("a", lambda a_prev, v: bmc.Normal(a_prev + 0.1 * v, 0.01), initial=bmc.Normal(1.0, 0.2))
    >>> dbn.add("y", lambda a: bmc.Normal(np.sin(a), 0.1))
    >>> filtered = bmc.filter(dbn, {"y": [0.8, 0.85, 0.8]}, engine=ExtendedKalmanFilter())
    >>> filtered.mean("a").shape, filtered.cov("a", "v").shape
    ((3,), (3, 2, 2))
    """

    label: ClassVar[str] = "extended Kalman filter"

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """Derivatives at the mean."""
        slopes = level.slopes(mean)
        if slopes is None:
            found, moments, slopes = self._differences(level, mean)
        else:
            found, moments = level(mean[None])
        scales = [None if m.scale is None else m.scale[0] for m in moments]
        return Made(found[0], slopes @ rows, level.noise(scales))

    @staticmethod
    def _differences(
        level: Level, mean: np.ndarray
    ) -> tuple[np.ndarray, list[Moments], np.ndarray]:
        """What a level makes of the mean, first, and central differences there, shape (*lead, e, c)."""
        c = mean.shape[-1]
        share = 1.0 if level.part.affine else _STEP  # of what is affine a long step loses no digits
        steps = 2.0 ** np.round(np.log2(share * np.maximum(np.abs(mean), level.part.sizes)))
        moves = np.moveaxis(steps[..., None, :] * np.eye(c), -2, 0)  # (c, *lead, c): one move each
        found, moments = level(np.concatenate([mean[None], mean + moves, mean - moves]))
        off = level.off(found[1 : c + 1], found[c + 1 :])
        return found, moments, np.moveaxis(off, 0, -1) / (2 * steps[..., None, :])


@dataclass(frozen=True)
class UnscentedKalmanFilter(NonlinearFilter):
    """Approximate beliefs about nonlinear templates: moments are those at a few points around the mean.

    Parameters
    ----------
    alpha, beta, kappa : float
        Of the scaled unscented transformation of n numbers: points lie ``alpha sqrt(n + kappa)`` standard
        deviations from the mean; the middle one weighs ``1 - n / (alpha^2 (n + kappa))`` in means and
        ``1 - alpha^2 + beta`` more in covariances.

    Raises
    ------
    ValueError
        An option is not finite, or ``alpha`` not positive.
    ParameterError
        In a run: ``n + kappa`` is not positive, or what comes of a negative weight is no covariance.

    Notes
    -----
    The additive form: noise is not among the numbers that points are laid for; its covariance is
    averaged over the points. Points are laid anew for every level of a slice: for the slice before, then
    around what is predicted. Other families than Normal and MvNormal, angles, counts and what takes no
    continuous values are treated as in ``ExtendedKalmanFilter``. What the points tell beyond a regression
    line is noise, so a slice is a linear model again and the smoother that of ``KalmanFilter``, with
    cross-covariances by points. ``most_likely`` is answered for linear-Gaussian templates only.

    References
    ----------
    Julier and Uhlmann (2004), Proc. IEEE 92; van der Merwe and Wan (2001), ICASSP; Särkkä and Svensson
    (2023), Bayesian Filtering and Smoothing, 2nd ed., ch. 8 and 9.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import UnscentedKalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(np.sin(x_prev), 0.3), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x**2, 0.5))
    >>> engine = UnscentedKalmanFilter()
    >>> bmc.smooth(dbn, {"y": [0.3, 0.5, 0.9]}, engine=engine).std("x").shape
    (3,)
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 2.0

    label: ClassVar[str] = "unscented Kalman filter"

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "kappa"):
            value = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not np.isfinite(value)
            ):
                raise ValueError(f"UnscentedKalmanFilter({name}={value!r}): give a finite number")
        if not self.alpha > 0:
            raise ValueError(
                f"UnscentedKalmanFilter(alpha={self.alpha!r}): give a positive number, such as 1.0"
            )

    def made_linear(self, level: Level, mean: np.ndarray, rows: np.ndarray) -> Made:
        """A regression line through sigma points; what is off the line is noise.

        In differences from the mean at pairs of opposite points, their halved difference is the line, and
        their sum is off it. So the covariance that is left is a sum of squares, and nothing is subtracted.
        """
        n, k = rows.shape[-2:]
        if not n:
            found, moments = level(mean[None])
            scales = [None if m.scale is None else m.scale[0] for m in moments]
            return Made(found[0], np.zeros((*found.shape[1:], k)), level.noise(scales))
        if n + self.kappa <= 0:
            raise _not_positive(
                f"points of {n} numbers lie sqrt({n} + kappa) standard deviations away"
            )
        if k < n:
            rows = np.concatenate([rows, np.zeros((*rows.shape[:-1], n - k))], axis=-1)
        turn, upper = np.linalg.qr(np.matrix_transpose(rows))
        root = np.matrix_transpose(upper)  # mean + root @ z, where z = turn' @ noise
        width = self.alpha**2 * (n + self.kappa)
        moves = np.moveaxis(np.sqrt(width) * root, -1, 0)
        found, moments = level(np.concatenate([mean[None], mean + moves, mean - moves]))
        weight = 0.5 / width
        off = level.off(found[1:], found[0])
        centre = weight * off.sum(axis=0)
        up, down = off[:n] - centre, off[n:] - centre
        line = np.moveaxis(up - down, 0, -1) * (weight * np.sqrt(width))
        bent = np.moveaxis(up + down, 0, -1) * np.sqrt(0.5 * weight)
        middle = 1.0 - n / width + 1.0 - self.alpha**2 + self.beta
        noise = level.noise([self._averaged(m.scale, weight, mean.ndim - 1) for m in moments])
        fresh = self._with_middle(bent, centre, middle, noise)
        link = (line @ np.matrix_transpose(turn))[..., :k]
        return Made(found[0] + centre, link, fresh)

    @staticmethod
    def _averaged(scale: np.ndarray | None, weight: float, lead: int) -> np.ndarray | None:
        """A node's noise, its covariance averaged over the points."""
        if scale is None or (scale == scale[:1]).all():
            return None if scale is None else scale[0]
        if scale.ndim == 2 + lead:
            squared = scale**2
            found = squared[0] + weight * (squared[1:] - squared[0]).sum(axis=0)
            root = np.sqrt(found) if (found >= 0).all() else None
        else:
            middle = 1.0 - weight * (len(scale) - 1)
            root = _joint_root(scale[0], middle, scale[1:], weight)
        if root is None:
            raise _not_positive("noise averaged over sigma points is not positive")
        return root

    @staticmethod
    def _with_middle(
        bent: np.ndarray, centre: np.ndarray, middle: float, noise: np.ndarray
    ) -> np.ndarray:
        """Roots of everything off the line, side by side."""
        if middle >= 0:
            return np.concatenate([bent, np.sqrt(middle) * centre[..., None], noise], axis=-1)
        whole = sum(a @ np.matrix_transpose(a) for a in (bent, noise))
        root = _root_of(whole + middle * centre[..., None] * centre[..., None, :])
        if root is None:
            raise _not_positive(
                f"the middle point weighs {middle:.3g}, and the covariance is not positive"
            )
        return root


# ---- private ------------------------------------------------------------------------------------


def _write(found: Filtered, k: int, whole: Layout, taken: Taken) -> None:
    """A slice's mean and root in the layout of the series; what is known there has no spread."""
    own = taken.layout
    found.increments[k] = taken.log_density
    found.innovations.put(k, own, taken.pattern, taken.made.root, taken.eta)
    for name, place in whole.rows.items():
        if name in own.rows:
            found.means[k][..., place] = taken.mean[..., own.rows[name]]
        else:
            node = whole.slices.first[name]
            value = np.broadcast_to(taken.known[name], node.value_shape).astype(float)
            found.means[k][..., place] = whole.packed(node, value)
    if own.n == whole.n:
        found.factors[k] = taken.factor
        return
    rows = _placed(whole, tuple(own.rows))
    carried = rows[: own.carried]
    columns = np.concatenate([carried, whole.carried + np.arange(own.n - own.carried)])
    found.factors[k][..., rows[:, None], columns] = taken.factor


def _write_turn(turns: Turns, k: int, whole: Layout, before: Layout, taken: Taken) -> None:
    """What carries a smoother back, in the layout of the series."""
    own, made = taken.layout, taken.made
    assert made.turn is not None
    turn = turned(made.turn, made.root.shape[-1], own.carried)
    there, here = _placed(whole, before.after), _placed(whole, own.after)
    turns.shifts[k][..., there] = multiplied(turn.shift, taken.eta)
    turns.links[k][..., there[:, None], here] = turn.link
    turns.spreads[k][..., there[:, None], there] = turn.spread


def _placed(whole: Layout, names: tuple[str, ...]) -> np.ndarray:
    """Where the numbers of some nodes stand in the layout of the series."""
    places = [np.arange(whole.rows[n].start, whole.rows[n].stop) for n in names]
    return np.concatenate([np.zeros(0, dtype=np.intp), *places])


def _joint_root(first: np.ndarray, middle: float, others: np.ndarray, weight: float) -> Any:
    """A root of a weighted sum of covariances, given roots of them, or None where it has none."""
    if middle < 0:
        squared = others @ np.matrix_transpose(others)
        return _root_of(middle * first @ np.matrix_transpose(first) + weight * squared.sum(axis=0))
    roots = np.concatenate([np.sqrt(middle) * first[None], np.sqrt(weight) * others])
    beside = np.matrix_transpose(np.concatenate(tuple(roots), axis=-1))
    return np.matrix_transpose(np.linalg.qr(beside, mode="r"))


def _root_of(covariance: np.ndarray) -> np.ndarray | None:
    """A root of a covariance, which may be singular; None of what is no covariance."""
    values, vectors = np.linalg.eigh(covariance)
    if (values >= -1e-9 * np.abs(values).max(axis=-1, keepdims=True)).all():
        return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return None


def _not_positive(what: str) -> ParameterError:
    return ParameterError(
        f"UnscentedKalmanFilter: {what}; use alpha=1, beta=0 and kappa=0 or more, or a ParticleFilter"
    )
