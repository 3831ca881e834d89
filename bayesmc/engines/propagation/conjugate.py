"""Messages in families of their own: factors that are linear in a family's statistics, in every state.

They multiply a belief of the family into the family: for every state of their finite variables the product is
exact, and only the mixture over states is matched, by expected statistics. What no finite variable switches
is never approximated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.engines.propagation.batch import Batch, Found, Outcome
from bayesmc.engines.propagation.beliefs import Beliefs
from bayesmc.factors.families import Family
from bayesmc.factors.tilted import Tilt, log_sum


@dataclass(eq=False)
class ConjugateBatch(Batch):
    """Factors linear in statistics of elements of one family, for every state of their finite variables.

    Attributes
    ----------
    field : int
        Which of the beliefs' families.
    at : ndarray of int, shape (count, m)
        The elements that a factor reads.
    coefficients : ndarray, shape (count, *cards, m, p)
    offsets : ndarray, shape (count, *cards)
    """

    field: int = 0
    at: Any = None
    coefficients: Any = None
    offsets: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.floor = -np.inf
        self.sites = np.zeros((*self.at.shape, self.coefficients.shape[-1]))

    @property
    def is_exact(self) -> bool:
        """Whether no finite variable switches what factors say."""
        return not self.cards

    def visit(self, beliefs: Beliefs, share: float, members: np.ndarray | None = None) -> Outcome:
        at = self.everyone if members is None else members
        held = beliefs.families[self.field]
        cavity, whole = self._faced(beliefs, at)
        found = self._tilted(beliefs, at)
        fine = np.isfinite(found.log) & (found.log > self.floor)
        towards = self._matched(held.family, found, whole.reshape(len(at), -1, *cavity.shape[1:]))
        proper = fine & np.isfinite(held.family.log_total(towards)).all(axis=-1)
        step = share if self.cards else 1.0
        change = step * (towards - cavity - self.sites[at])
        change = np.where(proper[:, None, None], change, 0.0)
        skipped = int((~proper).sum())
        before = held.naturals.copy()
        for _ in range(8):
            np.add.at(held.naturals, self.at[at], change)
            if np.isfinite(held.family.log_total(held.naturals)).all():
                self.sites[at] += change
                break
            held.naturals[...] = before
            change = 0.25 * change
        else:
            skipped += len(at)
        self._send_tables(beliefs, at, found, fine, step)
        self.logs[at] = self._constants(beliefs, found, at)
        return Outcome(skipped, 0.0)

    # ---- private -------------------------------------------------------------------------------

    def _faced(self, beliefs: Beliefs, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cavities, shape (f, m, p), and products with factors, shape (f, *cards, m, p)."""
        cavity = beliefs.families[self.field].naturals[self.at[at]] - self.sites[at]
        wide = cavity.reshape(len(at), *(1,) * len(self.cards), *cavity.shape[1:])
        return cavity, wide + self.coefficients[at]

    def _product(
        self,
        beliefs: Beliefs,
        at: np.ndarray,
        precision: np.ndarray,
        linear: np.ndarray,
        near: tuple[np.ndarray, np.ndarray],
    ) -> Tilt:
        family = beliefs.families[self.field].family
        cavity, whole = self._faced(beliefs, at)
        none = family.log_total(cavity).reshape(len(at), *(1,) * len(self.cards), -1)
        logs = self.offsets[at] + (family.log_total(whole) - none).sum(axis=-1)
        return Tilt(logs, linear, precision)

    def _matched(self, family: Family, found: Found, whole: np.ndarray) -> np.ndarray:
        """The members of the family with the expected statistics of mixtures over states."""
        if whole.shape[1] == 1:
            return whole[:, 0]
        flat = found.joint.reshape(len(whole), -1)
        with np.errstate(invalid="ignore"):
            weight = np.exp(flat - log_sum(flat)[:, None])[..., None, None]
        alive = weight > 0
        safe = np.where(alive, whole, 0.0)
        expected = np.where(alive, family.expected(np.where(alive, whole, family.one)), 0.0)
        towards = family.natural((weight * expected).sum(axis=1), (weight * safe).sum(axis=1))
        same = (whole == whole[:, :1]).all(axis=(1, 3))
        return np.where(same[..., None], whole[:, 0], towards)

    def _constants(self, beliefs: Beliefs, found: Found, at: np.ndarray) -> np.ndarray:
        held = beliefs.families[self.field]
        whole = held.naturals[self.at[at]]
        ratio = held.family.log_total(whole) - held.family.log_total(whole - self.sites[at])
        return super()._constants(beliefs, found, at) - ratio.sum(axis=-1)
