"""Draws as an ArviZ ``DataTree``: which groups, with what names of dimensions and coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import UnsupportedError, missing_extra
from bayesmc.network import Model, Observed
from bayesmc.results.over_time import TIMES, expanded, slices_of
from bayesmc.results.posterior import Posterior
from bayesmc.states import StateArray


def datatree(
    posterior: Posterior,
    log_likelihood: bool = False,
    predictive: Any = False,
    prior: Posterior | None = None,
    predictions: Posterior | None = None,
    rng: Any = None,
) -> Any:
    """The draws and data of a posterior with equally weighted draws; see ``Posterior.to_datatree``.

    Raises
    ------
    MissingExtraError
        Without arviz-base, or without xarray, which it needs for this (the extra ``arviz``).
    """
    try:
        import arviz_base
        import xarray  # noqa: F401
    except ImportError as error:
        package = (error.name or "arviz-base").partition(".")[0].replace("_", "-")
        raise missing_extra(package, "arviz") from None
    model = posterior.model
    free = _by_template(model, [n for n in posterior.names if posterior._is_free(n)])
    groups = {"posterior": {n: _numbered(posterior[n]) for n in free}}
    seen = {n: _with_gaps(model[n].decode(o.value), o) for n, o in posterior._seen.items()}
    data = {
        n: _over_time([seen.get(row) for row in rows])
        for n, rows in _by_template(model, seen, partly=True).items()
    }
    if data:
        groups["observed_data"] = data
    told = {"diverging": "divergences", "energy": "energies"}
    kept = {n: getattr(posterior, own, None) for n, own in told.items()}
    stats = {n: found for n, found in kept.items() if found is not None}
    if stats:
        groups["sample_stats"] = stats
    dims = {}
    for name, own in {**free, **_by_template(model, seen, partly=True)}.items():
        dims[name] = _dims(model, name, own)
    known = {n: _labelled(model[n].decode(v)) for n, v in getattr(posterior, "_inputs", {}).items()}
    if known:
        groups["constant_data"] = known
        dims |= {n: _dims(model, n, (n,)) for n in known}
    tree = arviz_base.from_dict(groups, dims=dims, coords=_coords(model))
    _tell_states(tree["posterior"], model, free)
    if log_likelihood:
        _attach(tree, _likelihoods(posterior))
    rows = expanded(model, _by_template(model, seen, partly=True))
    if predictive is not False:
        drawn = posterior.predict(rows, rng=rng) if predictive is True else predictive
        _attach(tree, _draws_of(drawn, "posterior_predictive", rows))
    if prior is not None:
        _attach(tree, _draws_of(prior, "prior", [n for n in prior.names if n not in rows]))
        _attach(tree, _draws_of(prior, "prior_predictive", rows))
    if predictions is not None:
        drawn_anew = [n for n in rows if n in getattr(predictions, "_stored", {})]
        _attach(
            tree, _draws_of(predictions, "predictions", drawn_anew, "predictions_constant_data")
        )
    return tree


# ---- private ------------------------------------------------------------------------------------


def _attach(tree: Any, other: Any) -> None:
    """The groups of another tree, whose plates may have other sizes."""
    for name, child in other.children.items():
        tree[name] = child.copy()


def _tell_states(group: Any, model: Model, rows: Mapping[str, Sequence[str]]) -> None:
    """What positions of labels stand for, as an attribute of the variable."""
    for name, own in rows.items():
        domain = model[own[0]].domain
        if domain is not None and domain.labels is not None:
            group[name].attrs["states"] = [str(state) for state in domain.labels]


def _dims(model: Model, name: str, rows: Sequence[str]) -> list[str]:
    """Names of the axes behind chains and draws: time, plates, and those of a vector."""
    node = model[rows[0]]
    own = [*node.plates, *(f"{name}_dim_{i}" for i in range(len(node.event_shape)))]
    return own if tuple(rows) == (name,) else ["time", *own]


def _coords(model: Model) -> dict[str, Any]:
    found = {p: list(model.labels.get(p, range(n))) for p, n in model.sizes.items()}
    if TIMES in model.cache:
        found["time"] = model.cache[TIMES]
    return found


def _draws_of(drawn: Posterior, group: str, names: Sequence[str], known: str = "") -> Any:
    """Draws of some nodes as one group, with the inputs that they were drawn for as another."""
    import arviz_base

    if drawn.weights is not None:
        raise UnsupportedError(
            f"to_datatree: the draws for the group {group!r} are weighted and ArviZ would drop the weights; "
            "give .resample(draws) of them"
        )
    model = drawn.model
    rows = _by_template(model, [n for n in names if n in model.nodes])
    told = _numbered if group == "prior" else _labelled
    values = {group: {n: told(drawn[n]) for n in rows}}
    dims = {n: _dims(model, n, own) for n, own in rows.items()}
    inputs: Any = getattr(drawn, "_inputs", {})
    if known and inputs:
        values[known] = {n: _labelled(model[n].decode(v)) for n, v in inputs.items()}
        dims |= {n: _dims(model, n, (n,)) for n in inputs}
    tree = arviz_base.from_dict(values, dims=dims, coords=_coords(model))
    if group == "prior":
        _tell_states(tree["prior"], model, rows)
    return tree


def _likelihoods(posterior: Posterior) -> Any:
    """Pointwise log likelihoods of what was observed; what was not is left out, as ArviZ takes no gaps."""
    import arviz_base

    model = posterior.model
    values, dims, coords = posterior.log_likelihood(), {}, _coords(model)
    for name, own in values.items():
        rows = slices_of(model, name) or (name,)
        event = len(model[rows[0]].event_shape)
        axes = _dims(model, name, rows)
        axes = axes[: len(axes) - event]
        gaps = np.isnan(own).all(axis=(0, 1))
        if gaps.any():
            values[name] = own[:, :, ~gaps]
            axis = f"{name}_observed"
            places = np.argwhere(~gaps).tolist()
            names = [coords.get(p, range(n)) for p, n in zip(axes, gaps.shape, strict=True)]
            told = [tuple(n[i] for n, i in zip(names, at, strict=True)) for at in places]
            coords[axis] = [one[0] if len(one) == 1 else ", ".join(map(str, one)) for one in told]
            axes = [axis]
        dims[name] = axes
    return arviz_base.from_dict({"log_likelihood": values}, dims=dims, coords=coords)


def _by_template(
    model: Model, names: Iterable[str], partly: bool = False
) -> dict[str, tuple[str, ...]]:
    """Nodes, and the slices of an unrolled template by its name, where all (or some) are there."""
    listed = list(names)
    found: dict[str, tuple[str, ...]] = {}
    for name in listed:
        base = name.rpartition("[")[0]
        rows = slices_of(model, base) if name.endswith("]") else None
        whole = rows is not None and (partly or set(rows) <= set(listed))
        found[base if whole else name] = rows if whole and rows is not None else (name,)
    return found


def _over_time(rows: Sequence[Any]) -> np.ndarray:
    """What was observed, time first where there are slices; NaN (None for labels) in those without data."""
    if len(rows) == 1:
        return _labelled(rows[0])
    known = [None if row is None else _labelled(row) for row in rows]
    one = next(row for row in known if row is not None)
    if all(row is not None for row in known):
        return np.stack(known)  # type: ignore[arg-type]
    is_number = one.dtype.kind in "biuf"
    gap = np.full(one.shape, np.nan if is_number else None, dtype=float if is_number else object)
    return np.stack([gap if row is None else row.astype(gap.dtype) for row in known])


def _numbered(values: np.ndarray) -> np.ndarray:
    """Plain numbers: of labels their positions, since ArviZ reckons with what is in a posterior."""
    return values.codes if isinstance(values, StateArray) else np.asarray(values)


def _labelled(values: np.ndarray) -> np.ndarray:
    """Plain values: labels where there are labels."""
    return values.labels if isinstance(values, StateArray) else np.asarray(values)


def _with_gaps(values: np.ndarray, seen: Observed) -> np.ndarray:
    """Observed values with NaN (None for labels) where nothing was observed."""
    if seen.mask is None:
        return values
    if isinstance(values, StateArray):
        labels = values.labels.astype(object)
        labels[~seen.mask] = None
        return labels
    numbers = np.array(values, dtype=float)
    numbers[~seen.mask] = np.nan
    return numbers
