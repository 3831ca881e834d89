"""Like factors of one number each, without finite variables: a visit to all of them as flat arrays.

Rows of a regression are such factors. What ``Batch`` does for any factor is done here without axes that have
one entry: all cavities from one belief, all messages at once (parallel updates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesmc.engines.propagation.batch import ROUNDING, Batch, Outcome, cautious
from bayesmc.engines.propagation.beliefs import Beliefs, Blocks
from bayesmc.factors.tilted import log_integral


@dataclass(eq=False)
class LineBatch(Batch):
    """Factors that read one direction and nothing finite."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.members = self._index(self.everyone)
        self.turned: np.ndarray | None = None
        if self.is_shared and (self.columns[:1] == np.arange(self.columns.shape[1])).all():
            self.turned = np.ascontiguousarray(self.weights[:, 0].T)

    def visit(self, beliefs: Beliefs, share: float, members: np.ndarray | None = None) -> Outcome:
        if members is not None:
            return super().visit(beliefs, share, members)
        blocks = beliefs.blocks[self.block]
        mean, var = self._along(blocks)
        own = 1.0 / var
        precision = own - self.precision[:, 0, 0]
        linear = mean * own - self.linear[:, 0]
        messages = getattr(self.kernel, "messages", None)
        if messages is not None and (precision > ROUNDING * own).all():
            towards, also = messages(self.members, precision, linear)
            towards -= self.precision[:, 0, 0]
            also -= self.linear[:, 0]
            if np.isfinite(towards.sum() + also.sum()):
                if share < 1.0:
                    towards, also = share * towards, share * also
                return Outcome(0 if self._go(blocks, towards, also) else self.count, 0.0)
        precision[np.abs(precision) < ROUNDING * own] = 0.0
        wide = precision[:, None, None], linear[:, None], (mean[:, None], var[:, None, None])
        found = self.kernel.tilted(self.members, *wide)
        self.error = max(self.error, found.error)
        new_mean, new_var = found.mean[:, 0], found.cov[:, 0, 0]
        towards = 1.0 / new_var
        change = towards - own
        move = new_mean * towards - mean * own
        # sums are finite where all numbers are, and no others are looked at one by one
        total = found.log.sum() + change.sum() + move.sum() + towards.sum()
        skipped = 0
        if not (np.isfinite(total) and towards.min() > 0.0):
            proper = (towards > 0.0) & np.isfinite(towards) & np.isfinite(found.log + move)
            skipped = int((~proper).sum())
            change, move = np.where(proper, change, 0.0), np.where(proper, move, 0.0)
        step = cautious(share, found.error)
        if self._go(blocks, step * change, step * move):
            return Outcome(skipped, found.error)
        return Outcome(skipped + self.count, found.error)

    def constants(self, beliefs: Beliefs) -> np.ndarray:
        """Logs by which factors exceed their messages, given beliefs as they are."""
        mean, var = self._along(beliefs.blocks[self.block])
        own = 1.0 / var
        total = mean * own
        precision, linear = own - self.precision[:, 0, 0], total - self.linear[:, 0]
        precision[np.abs(precision) < ROUNDING * own] = 0.0
        wide = precision[:, None, None], linear[:, None], (mean[:, None], var[:, None, None])
        whole = self.kernel.tilted(self.members, *wide).log
        return whole - log_integral(own[:, None, None], total[:, None])

    # ---- private -------------------------------------------------------------------------------

    def _is_whole(self, blocks: Blocks) -> bool:
        """Whether every factor reads all of one component, in order."""
        return self.turned is not None and len(self.turned) == blocks.linear.shape[1]

    def _along(self, blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
        """Means and variances of all directions."""
        if not self._is_whole(blocks):
            mean, var = self._projected(blocks, self.everyone)
            return mean[:, 0], var[:, 0, 0]
        assert self.turned is not None
        c = self.component[0]
        mean = blocks.mean[c] @ self.turned
        return mean, np.einsum("mf,mf->f", blocks.cov[c] @ self.turned, self.turned)

    def _go(self, blocks: Blocks, change: np.ndarray, move: np.ndarray) -> bool:
        """Move messages as far as components stay proper; whether any could be moved."""
        touched = self._touched
        kept = blocks.precision[touched], blocks.linear[touched]
        for _ in range(8):
            self._put(blocks, change, move)
            improper = blocks.refreshed(touched)
            if not improper.any():
                self.precision[:, 0, 0] += change
                self.linear[:, 0] += move
                return True
            broken = np.isin(self.component, touched[improper])
            blocks.precision[touched], blocks.linear[touched] = kept
            change = np.where(broken, 0.25 * change, change)
            move = np.where(broken, 0.25 * move, move)
        blocks.precision[touched], blocks.linear[touched] = kept
        blocks.refreshed(touched)
        return False

    def _put(self, blocks: Blocks, change: np.ndarray, move: np.ndarray) -> None:
        if not self._is_whole(blocks):
            self._add(blocks, self.everyone, change[:, None, None], move[:, None])
            return
        assert self.turned is not None
        c = self.component[0]
        added = (self.turned * change) @ self.weights[:, 0]
        blocks.precision[c] += 0.5 * (added + added.T)
        blocks.linear[c] += self.turned @ move
