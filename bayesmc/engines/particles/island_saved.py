"""Runs of islands that are saved stretch by stretch, so that another process can go on with them."""

from __future__ import annotations

from typing import Any

from bayesmc.engines.particles.island_answers import IslandRows
from bayesmc.errors import CheckpointError, UnsupportedError
from bayesmc.storage import Saver, packed
from bayesmc.workers.memory import hold, opened


class SavedIslands:
    """Saves one run whenever all islands have passed a stretch of rows.

    Where stretches end is part of the state, so that a run that is gone on with cuts its rows as one that was
    never stopped, and adds up the same numbers in the same order.

    Parameters
    ----------
    saver : Saver
    rows : IslandRows
    """

    def __init__(self, saver: Saver, rows: IslandRows) -> None:
        self.saver, self.rows = saver, rows
        #: stretches that are saved
        self._saved = 0
        self._is_tried = False

    def begin(self, where: str | None) -> dict[str, Any] | None:
        """What ``passed`` was given last, clouds in shared memory again; None where nothing was saved."""
        state = self.saver.state
        if state is None or "islands" not in state:
            return None
        self.rows.go_on(
            [stretch for rows in self.saver.rows() for stretch in rows], state["answers"]
        )
        self._saved, self._is_tried = len(self.rows.stretches), True
        found = dict(state["islands"])
        if where is not None:
            met = {id(cloud): hold(cloud, where) for cloud in found["clouds"]}
            found["clouds"] = [met[id(cloud)] for cloud in found["clouds"]]
        return found

    def passed(self, state: dict[str, Any]) -> None:
        """All islands have passed a stretch: save if it is time."""
        if self._is_tried and not self.saver.due():
            return
        whole = {"islands": self._data(state), "answers": self.rows.state}
        kept = {n: v for n, v in (self.saver.state or {}).items() if n == "compiled"}
        if not self._is_tried:
            self._try(whole)
        if self.saver.due():
            self.saver.save(self.rows.since(self._saved), {**kept, **whole})
            self._saved = len(self.rows.stretches)

    # ---- private -------------------------------------------------------------------------------

    @staticmethod
    def _data(state: dict[str, Any]) -> dict[str, Any]:
        """A state with clouds themselves in the place of where they lie; copies stay one object."""
        met = {id(cloud): opened(cloud) for cloud in state["clouds"]}
        return {**state, "clouds": [met[id(cloud)] for cloud in state["clouds"]]}

    def _try(self, whole: dict[str, Any]) -> None:
        """Refuse at once what cannot be saved later."""
        self._is_tried = True
        try:
            packed(whole)
        except UnsupportedError as error:
            raise CheckpointError(
                f"IslandFilter(checkpoint=): what these particles carry cannot be saved: {error}; leave "
                "checkpoint= out, or marginalize="
            ) from error
