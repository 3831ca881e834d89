"""A finite variable over sites whose factors make chains or trees: all sites in one draw."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.forest import Forest
from bayesmc.kernels.sites import Sites, sites_of
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values

#: entries of tables, for one chain
_ENTRIES = 1 << 21


def site_forest(blanket: Blanket) -> SiteForest | None:
    """The kernel of a variable over sites; None where factors make cycles, or read other hidden quantities.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.forest_sites import site_forest
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> chain = bmc.FactorGraph("chain", plates={"site": 6})
    >>> chain.variable("s", (-1, 1), plates="site")
    >>> i = np.arange(5)
    >>> chain.factor(lambda a, b: 0.5 * a * b, scope=("s", "s"), index=(i, i + 1))
    >>> site_forest(Blanket(target_of(pose(chain, None)), "s")).match
    'filtering and sampling along 5 pairs of 6 sites, 2 states'
    """
    domain = blanket.node.domain
    if domain is None or not blanket.node.plates or not blanket.size:
        return None
    pairs = sum(len(c.relation.edges) for c in blanket.children if c.relation.kind == "rows")
    # sites of a cycle have as many pairs; some factors may stand on the same one
    if not 0 < pairs < 4 * blanket.size:
        return None
    if (2 * blanket.size) * domain.size**2 > _ENTRIES:
        return None
    sites = sites_of(blanket)
    if sites is None or any(b.names != (blanket.name,) * 2 for b in sites.batches):
        return None
    try:
        return SiteForest(blanket, sites)
    except ValueError:  # a cycle
        return None


class SiteForest(Kernel):
    """Draws all sites from their joint distribution.

    Parameters
    ----------
    blanket : Blanket
    sites : Sites
        Factors on single sites and on pairs of this variable alone.

    Raises
    ------
    ValueError
        Their pairs make a cycle.
    """

    label = "forest"

    def __init__(self, blanket: Blanket, sites: Sites) -> None:
        self.names = (blanket.name,)
        domain = blanket.node.domain
        assert domain is not None
        self.dtype, states = domain.dtype, domain.size
        every = [np.sort(np.stack(b.index, axis=1), axis=1) for b in sites.batches]
        edges, place = np.unique(np.concatenate(every), axis=0, return_inverse=True)
        self.forest = Forest(blanket.size, edges)
        self.single = sites.single.copy()
        seen = blanket.target.seen(blanket.name)
        if seen is not None and seen.mask is not None:
            other = np.arange(states)[:, None] != seen.value.ravel()
            self.single[other & seen.mask.ravel()] = -np.inf
        self.pairs = np.zeros((states, states, len(edges)))
        begin = 0
        for batch in sites.batches:
            log = np.broadcast_to(batch.log, (states, states, batch.rows))
            turned = batch.index[0] > batch.index[1]
            log = np.where(turned, log.swapaxes(0, 1), log)
            at: Any = (slice(None), slice(None), place.reshape(-1)[begin : begin + batch.rows])
            np.add.at(self.pairs, at, log)
            begin += batch.rows
        size = f"{len(edges)} pairs of {blanket.size} sites, {states} states"
        self.match = f"filtering and sampling along {size}"

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        (name,) = self.names
        chains = len(values[name])
        tables = np.empty((*self.pairs.shape[:2], self.forest.tables, chains))
        tables[:, :, : self.forest.edges] = self.pairs[..., None]
        single = np.repeat(self.single[..., None], chains, axis=2)
        uniform = np.ascontiguousarray(rng.random((chains, self.forest.count)).T)
        drawn, _ = self.forest.draw(single, tables, uniform, name)
        return {name: drawn.T.astype(self.dtype).reshape(values[name].shape)}, memory
