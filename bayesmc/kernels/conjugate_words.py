"""Why a node has no closed form, in words: what its child is, and which parameter it enters how."""

from __future__ import annotations

from typing import Any

from bayesmc.distributions import Categorical, Multinomial, MvNormal
from bayesmc.errors import TraceError
from bayesmc.expression import Family, expressions_of, leaf
from bayesmc.network.expressions import Opaque
from bayesmc.passes.affine import affine
from bayesmc.passes.features import LOG1M, statistics
from bayesmc.passes.log_density import log_density
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Term

#: parameters of vectors -> how a node must enter them
_OF_VECTORS: dict[tuple[Any, str], str] = {
    (MvNormal, "loc"): "mean", (MvNormal, "cov"): "multiple", (MvNormal, "scale_tril"): "power",
    (MvNormal, "scale_diag"): "power", (Categorical, "probs"): "shares",
    (Multinomial, "probs"): "shares",
}  # fmt: skip


def why_not(blanket: Blanket, term: Term, prior: str) -> str:
    """Why a child makes no conjugate pair with a node under a prior."""
    name, child = blanket.name, term.name
    if term.is_potential:
        return f"it enters the potential {child!r}"
    if isinstance(term.read, Opaque):
        return f"child {child!r} cannot be followed ({term.read.reason})"
    family = term.read.result
    if not isinstance(family, Family):
        return f"child {child!r} is no distribution that can be followed"
    word = getattr(family.make, "__name__", str(family.make))
    parameters = family.parameters.items()
    read = [k for k, v in parameters if any(name in e.leaves for e in expressions_of(v))]
    forms = {k: form for k in family.parameters if (form := _form(family, k, read)) is not None}
    if not forms:
        return f"child {child!r} is {word}, which makes no conjugate pair"
    if len(read) > 1:
        return f"it enters {' and '.join(read)} of child {child!r}"
    (parameter,) = read
    if parameter not in forms:
        return f"it enters the {parameter} of {word} {child!r}"
    told = f"the {parameter} of child {child!r}"
    fits = _fits(forms[parameter], prior)
    if not fits:
        return f"child {child!r} is {word}, which makes no conjugate pair with a {prior} prior"
    why = _bent(family.parameters[parameter], name) if forms[parameter] == "mean" else ""
    if why:
        return f"{told} is not known to be affine in it (after {why})"
    if len(blanket.classes) > 1 or forms[parameter] == "mean":
        return f"{told} may depend on several elements of {name!r}"
    if forms[parameter] == "power":
        return f"{told} is not known to be a power of it times a constant"
    if forms[parameter] == "multiple":
        many = blanket.event_shape == (family.parameters[parameter].shape[-1],) * 2
        what = "its value times a number" if many else "a power of it times a constant"
        return f"{told} is not known to be {what}"
    return f"{told} is not known to be its value itself"


# ---- private ------------------------------------------------------------------------------------

_PRIORS = {
    "mean": ("Normal", "MvNormal", "Uniform"),
    "power": ("Gamma", "InverseGamma", "Exponential", "Uniform"),
    "multiple": ("Gamma", "InverseGamma", "Exponential", "Uniform", "InverseWishart"),
    "share": ("Beta", "Uniform"),
    "shares": ("Beta", "Dirichlet", "Uniform"),
}


def _fits(form: str, prior: str) -> bool:
    return prior.removeprefix("truncated ") in _PRIORS[form]


def _form(family: Family, parameter: str, read: list[str]) -> str | None:
    """How a node must enter a parameter: as the features tell that this parameter has itself."""
    if (family.make, parameter) in _OF_VECTORS:
        return _OF_VECTORS[family.make, parameter]
    others: dict[str, Any] = {**family.parameters}
    if family.parameters[parameter] is None:  # given instead of what is read
        others |= dict.fromkeys(read)
    others[parameter] = leaf("\0itself", ())
    try:
        found = statistics(
            log_density(Family(family.make, others), leaf("\0value", ())), "\0itself"
        )
    except (TraceError, TypeError):
        return None
    if set(found.coefficients) == {1.0, 2.0}:
        return "mean"
    return "share" if LOG1M in found.coefficients else "power"


def _bent(value: Any, name: str) -> str:
    """The operation after which a parameter is no longer affine."""
    try:
        affine(value, [name])
    except TraceError as error:
        return str(error).removesuffix(" is not affine")
    return ""
