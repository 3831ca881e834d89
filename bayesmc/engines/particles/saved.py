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
    late : Recorded or None
        Answers that come some rows late.
    """

    def __init__(
        self,
        saver: Saver,
        record: Recorded,
        looks: Replicates | None,
        rng: np.random.Generator,
        late: Recorded | None = None,
    ) -> None:
        self.saver, self.looks, self.rng = saver, looks, rng
        #: what is kept of the slices, by its name in the file, and of how many all is settled that is saved
        self.records = {"written": record} | ({} if late is None else {"late": late})
        self._settled = dict.fromkeys(self.records, 0)
        #: slices that were passed and are saved
        self._passed = 0
        #: what was chosen when the run was begun
        self._chosen = {n: v for n, v in (saver.state or {}).items() if n in CHOSEN}
        self._is_tried = False

    def begin(self) -> tuple[int, Particles | None]:
        """The number of slices that were passed, and the particles of the last one."""
        saved = self.saver.state
        if saved is None or "now" not in saved:
            return 0, None
        written: dict[str, list[Written]] = {what: [] for what in self.records}
        for rows in self.saver.rows():
            for what, pieces in written.items():
                pieces += rows[what]
            if self.looks is not None:
                self.looks.put(rows["first"], rows["looks"])
        self._passed, self._is_tried = saved["passed"], True
        for what, record in self.records.items():
            self._settled[what] = sum(map(count, written[what]))
            record.go_on(written[what], saved["unsettled"][what])
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
        settled = {w: r.written_since(self._settled[w]) for w, r in self.records.items()}
        rows: dict[str, Any] = {"first": self._passed, **settled}
        if self.looks is not None:
            rows["looks"] = self.looks.rows(self._passed, k + 1)
        self.saver.save(rows, self._state(k, now))
        for what, pieces in settled.items():
            self._settled[what] += sum(map(count, pieces))
        self._passed = k + 1

    # ---- private -------------------------------------------------------------------------------

    def _state(self, k: int, now: Particles | None) -> dict[str, Any]:
        return {
            **self._chosen,
            "passed": k + 1,
            "now": now,
            "generator": self.rng.bit_generator.state,
            "looks": None if self.looks is None else self.looks.state,
            "unsettled": {what: record.unsettled() for what, record in self.records.items()},
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
