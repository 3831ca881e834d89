"""Runs of particle filters that are saved as the slices pass, so that another process can go on with them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from bayesmc.engines.particles.predictive import Replicates
from bayesmc.engines.particles.smc import Particles
from bayesmc.engines.particles.written import Written, count
from bayesmc.errors import CheckpointError, UnsupportedError
from bayesmc.storage import Saver, packed

#: what of the choices of a run is made once, and kept in its file
CHOSEN = ("particles", "compiled")


class Recorded(Protocol):
    """What is kept of the slices (``record.Record``)."""

    def written_since(self, slices: int) -> list[Written]:
        """What is settled of the slices from one on."""
        ...

    def unsettled(self) -> dict[str, Any]:
        """What is yet to change."""
        ...

    def go_on(self, written: list[Written], unsettled: dict[str, Any]) -> None:
        """Be where another record was."""
        ...


class SavedFilter:
    """Saves one run.

    Parameters
    ----------
    saver : Saver
    record : Record
    looks : Replicates or None
        What compares rows with those that were expected.
    rng : Generator
        That of the filter.
    """

    def __init__(
        self, saver: Saver, record: Recorded, looks: Replicates | None, rng: np.random.Generator
    ) -> None:
        self.saver, self.record, self.looks, self.rng = saver, record, looks, rng
        #: slices that are saved: that were passed, and of which all is settled
        self._passed = self._settled = 0
        #: what was chosen when the run was begun
        self._chosen = {n: v for n, v in (saver.state or {}).items() if n in CHOSEN}
        self._is_tried = False

    def begin(self) -> tuple[int, Particles | None]:
        """The number of slices that were passed, and the particles of the last one."""
        saved = self.saver.state
        if saved is None or "now" not in saved:
            return 0, None
        written: list[Written] = []
        for rows in self.saver.rows():
            written += rows["written"]
            if self.looks is not None:
                self.looks.put(rows["first"], rows["looks"])
        self._settled = sum(map(count, written))
        self._passed, self._is_tried = saved["passed"], True
        self.record.go_on(written, saved["unsettled"])
        self.rng.bit_generator.state = saved["generator"]
        if self.looks is not None:
            self.looks.go_on(saved["looks"])
        return self._passed, saved["now"]

    def passed(self, k: int, now: Particles | None) -> None:
        """The k-th slice is passed: save if it is time."""
        if not self._is_tried:
            self._try(now)
        if not self.saver.due():
            return
        written = self.record.written_since(self._settled)
        rows: dict[str, Any] = {"first": self._passed, "written": written}
        if self.looks is not None:
            rows["looks"] = self.looks.rows(self._passed, k + 1)
        self.saver.save(rows, self._state(k, now))
        self._settled += sum(map(count, written))
        self._passed = k + 1

    # ---- private -------------------------------------------------------------------------------

    def _state(self, k: int, now: Particles | None) -> dict[str, Any]:
        return {
            **self._chosen,
            "passed": k + 1,
            "now": now,
            "generator": self.rng.bit_generator.state,
            "looks": None if self.looks is None else self.looks.state,
            "unsettled": self.record.unsettled(),
        }

    def _try(self, now: Particles | None) -> None:
        """Refuse at once what cannot be saved later."""
        self._is_tried = True
        try:
            packed(self._state(0, now))
        except UnsupportedError as error:
            raise CheckpointError(
                f"ParticleFilter(checkpoint=): what these particles carry cannot be saved: {error}; leave "
                "checkpoint= out, or marginalize="
            ) from error
