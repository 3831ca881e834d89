"""How parents reach a child, against loops over single elements: any plate order, any batch ranks."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.network.calling import Aligner
from bayesmc.network.labels import Domain
from bayesmc.plates import PlateArray
from bayesmc.testing import session

PLATES = "abcd"


def elements(sizes, names):
    for index in itertools.product(*(range(sizes[p]) for p in names)):
        yield dict(zip(names, index, strict=True))


def pick(value, plates, where, b, event=0):
    """One element of a stored value ``(*batch, *plates, *event)`` by plate name."""
    lead = value.ndim - len(plates) - event
    own = b[len(b) - lead :] if lead else ()
    own = tuple(i if n > 1 else 0 for i, n in zip(own, value.shape, strict=False))
    return value[(*own, *(where[p] for p in plates))]


@st.composite
def subsets(draw, minimum=0):
    order = draw(st.permutations(PLATES))
    return tuple(order[: draw(st.integers(minimum, 4))])


@given(
    subsets(),
    subsets(),
    st.sampled_from(((), (2,), (3, 2))),
    st.sampled_from(((), (1,), (2,), (2, 3), (1, 3), (2, 2, 2))),
    st.lists(st.sampled_from((1, 2, 3)), min_size=4, max_size=4),
    st.booleans(),
)
def test_argument_is_the_parents_element(child, parent, event, batch, sizes, labelled):
    sizes = dict(zip(PLATES, sizes, strict=True))
    shape = batch + tuple(sizes[p] for p in parent) + event
    domain = Domain(int(np.prod(shape)), 5) if labelled else None
    value = np.arange(np.prod(shape)).reshape(shape)
    link = Aligner(child, parent, len(event), domain)
    argument = link(value)
    foreign = tuple(p for p in parent if p not in child)
    own = tuple(sizes[p] if p in parent else 1 for p in child)
    if foreign:
        assert isinstance(argument, PlateArray)
        assert argument.plates == foreign and argument.event_ndim == len(event)
    array = argument.array if foreign else argument
    assert array.shape == batch + own + tuple(sizes[p] for p in foreign) + event
    assert not array.flags.writeable
    assert link.batch_shape(value) == batch
    array = np.broadcast_to(
        array,
        batch + tuple(sizes[p] for p in (*child, *foreign)) + event,
    )
    for b in np.ndindex(batch):
        for where in elements(sizes, (*child, *foreign)):
            got = array[(*b, *(where[p] for p in (*child, *foreign)))]
            expected = pick(value, parent, where, b, len(event)) + (5 if labelled else 0)
            np.testing.assert_array_equal(got, expected)


def all_orders(names):
    return list(itertools.permutations(names))


@pytest.mark.parametrize("sizes", [(2, 2, 2, 2), (3, 2, 3, 2), (1, 2, 1, 3)])
def test_two_shared_and_two_foreign_plates_in_every_order(sizes):
    """All 24 orders of the parent's plates times both orders of the child's and of an index's."""
    sizes = dict(zip(PLATES, sizes, strict=True))  # a, b shared; c, d foreign
    rng = np.random.default_rng(1)
    for parent in all_orders(PLATES):
        value = rng.normal(size=(3, *(sizes[p] for p in parent)))
        for child in all_orders("ab"):
            v = Aligner(child, parent, 0, None)(value)
            i = rng.integers(0, sizes["c"], size=(2, 1, *(sizes[p] for p in child)))
            j = rng.integers(0, sizes["d"], size=(3, *(sizes[p] for p in child)))
            keys = {"c": i, "d": j}
            both = np.broadcast_to(
                v[keys[v.plates[0]], keys[v.plates[1]]], (2, 3, *(sizes[p] for p in child))
            )
            total = v.sum("d")[i]
            for b in np.ndindex(2, 3):
                for where in elements(sizes, child):
                    own = tuple(where[p] for p in child)
                    c, d = i[(b[0], 0, *own)], j[(b[1], *own)]
                    assert both[(*b, *own)] == pick(value, parent, {**where, "c": c, "d": d}, b)
                    expected = sum(
                        pick(value, parent, {**where, "c": c, "d": k}, b) for k in range(sizes["d"])
                    )
                    np.testing.assert_allclose(
                        np.broadcast_to(total, both.shape)[(*b, *own)], expected
                    )


# ---- whole nets against a loop ------------------------------------------------------------------


@st.composite
def gathering_nets(draw):
    """Plates of a vector parent, an index, a weight and a child; some foreign to the child."""
    sizes = {p: draw(st.sampled_from((1, 2, 2, 3))) for p in PLATES}
    order = draw(st.permutations(PLATES))
    foreign = order[0]  # gathered by z
    child = tuple(draw(st.permutations(order[1:3]))[: draw(st.integers(0, 2))])
    spare = order[3] if draw(st.booleans()) else None  # foreign too, reduced
    table = [foreign, *(p for p in child if draw(st.booleans())), *([spare] if spare else [])]
    v = tuple(draw(st.permutations(table)))
    z = tuple(draw(st.permutations([p for p in child if draw(st.booleans())])))
    w = tuple(draw(st.permutations([p for p in child if draw(st.booleans())])))
    ranks = [draw(st.sampled_from(((), (2,), (3, 2), (3, 1), (1,)))) for _ in range(4)]
    return sizes, foreign, spare, child, v, z, w, ranks


@given(gathering_nets(), st.integers(0, 999))
@settings(max_examples=session.scaled(100, 10))
def test_log_prob_of_a_gathering_net_is_the_loop(layout, seed):
    """The joint density of values with mixed batch ranks equals a sum over single elements."""
    sizes, foreign, spare, child, v_plates, z_plates, w_plates, ranks = layout
    rng = np.random.default_rng(seed)
    net = bmc.BayesNet(plates=sizes)
    net.add("v", bmc.Normal(0.0, 1.0), plates=v_plates)
    net.add("z", bmc.DiscreteUniform(0, sizes[foreign] - 1), plates=z_plates)
    net.add("w", bmc.Gamma(2.0, 1.0), plates=w_plates)

    def x(v, z, w):
        v = np.tanh(v)
        v = v.sum(spare) if spare else v
        return bmc.Normal(v[z] + w, 1.5)

    net.add("x", x, plates=child)

    def shaped(batch, plates):
        return batch + tuple(sizes[p] for p in plates)

    values = {
        "v": rng.normal(size=shaped(ranks[0], v_plates)),
        "z": rng.integers(0, sizes[foreign], size=shaped(ranks[1], z_plates)),
        "w": rng.gamma(2.0, size=shaped(ranks[2], w_plates)),
        "x": rng.normal(size=shaped(ranks[3], child)),
    }
    batch = np.broadcast_shapes(*ranks)
    got = np.broadcast_to(net.log_prob(values), batch)
    assert net.log_prob(values).shape == batch

    def density(x, loc, scale):
        return -0.5 * ((x - loc) / scale) ** 2 - np.log(scale) - 0.5 * np.log(2 * np.pi)

    for b in np.ndindex(batch):
        total = 0.0
        for where in elements(sizes, v_plates):
            total += density(pick(values["v"], v_plates, where, b), 0.0, 1.0)
        total -= np.log(sizes[foreign]) * np.prod([sizes[p] for p in z_plates], dtype=int)
        for where in elements(sizes, w_plates):
            one = pick(values["w"], w_plates, where, b)
            total += np.log(one) - one
        for where in elements(sizes, child):
            z = int(pick(values["z"], z_plates, where, b))
            places = [{**where, foreign: z, **more} for more in elements(sizes, spare or "")]
            loc = sum(np.tanh(pick(values["v"], v_plates, p, b)) for p in places)
            loc = loc + pick(values["w"], w_plates, where, b)
            total += density(pick(values["x"], child, where, b), loc, 1.5)
        np.testing.assert_allclose(got[b], total, rtol=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_equal_sizes_everywhere(size):
    """Draws, plates, states and components all of one size: nothing may be told apart by size."""
    rng = np.random.default_rng(size)
    net = bmc.BayesNet(plates={"p": size, "k": size})
    design = rng.normal(size=(size, size))
    net.add("beta", bmc.MvNormal(np.zeros(size), np.eye(size)), plates="k")
    net.add("z", bmc.Categorical(np.ones(size) / size), plates="p")
    net.add("x", lambda beta, z: bmc.Normal(np.vecdot(design, beta[z]), 1.0), plates="p")
    values = {
        "beta": rng.normal(size=(size, size, size)),
        "z": rng.integers(0, size, size=(size, size)),
        "x": rng.normal(size=(size, size)),
    }
    got = net.log_prob(values)
    assert got.shape == (size,)
    for b in range(size):
        beta, z, x = (values[n][b] for n in ("beta", "z", "x"))
        total = -0.5 * (beta**2).sum() - 0.5 * size * (size + 1) * np.log(2 * np.pi)
        total -= size * np.log(size)
        total += sum(-0.5 * (x[p] - design[p] @ beta[z[p]]) ** 2 for p in range(size))
        np.testing.assert_allclose(got[b], total, rtol=1e-12)
    draws = net.sample(size, rng=1)
    assert draws["beta"].shape == (size, size, size) and draws["x"].shape == (size, size)


def test_vector_parents_in_own_and_foreign_plates():
    """np.vecdot and np.matvec with a vector parent without plates, in shared and in foreign ones."""
    rng = np.random.default_rng(4)
    net = bmc.BayesNet(plates={"g": 3, "p": 4})
    design = rng.normal(size=(4, 2))
    a = np.array([[0.5, 0.2], [-0.1, 0.9]])
    net.add("beta", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("state", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="p")
    net.add("effect", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="g")
    net.add(
        "y",
        lambda beta, state, effect: bmc.Normal(
            np.vecdot(design, beta) + state[..., 1] + np.vecdot(design, effect).sum("g"), 1.0
        ),
        plates="p",
    )
    net.add("next", lambda state: bmc.MvNormal(np.matvec(a, state), np.eye(2)), plates="p")
    net.add("moved", lambda effect: np.matvec(a, effect).mean("g"))
    assert net["moved"].event_shape == (2,)
    draws = net.sample(5, rng=2)
    np.testing.assert_allclose(
        draws["moved"], np.einsum("ij,ngj->ni", a, draws["effect"]) / 3, rtol=1e-12
    )
    loc = (
        np.einsum("pj,nj->np", design, draws["beta"])
        + draws["state"][..., 1]
        + np.einsum("pj,ngj->np", design, draws["effect"])
    )
    total = -0.5 * ((draws["y"] - loc) ** 2).sum(-1)
    total += -0.5 * ((draws["next"] - np.einsum("ij,npj->npi", a, draws["state"])) ** 2).sum(
        (-1, -2)
    )
    for name, axes in (("beta", -1), ("state", (-1, -2)), ("effect", (-1, -2))):
        total += -0.5 * (draws[name] ** 2).sum(axes)
    count = 2 + 8 + 6 + 4 + 8
    np.testing.assert_allclose(
        net.log_prob(draws), total - 0.5 * count * np.log(2 * np.pi), rtol=1e-11
    )


def test_index_by_inputs_constants_and_foreign_parents():
    """A pupil's school is data, a constant array, or another unplated reduction of foreign plates."""
    school = np.array([1, 0, 2, 1])
    net = bmc.BayesNet(plates={"school": 3, "pupil": 4})
    net.add("effect", bmc.Normal(0.0, 1.0), plates="school")
    net.input("which", plates="pupil")
    net.add("from_constant", lambda effect: effect[school], plates="pupil")
    net.add("from_input", lambda effect, which: effect[which], plates="pupil")
    net.add("best", bmc.DiscreteUniform(0, 2), plates="pupil")
    net.add("total", lambda effect, best: effect[best].sum("pupil"))
    net.add("first", lambda effect: effect[0])
    draws = net.sample(6, rng=0, inputs={"which": school})
    np.testing.assert_array_equal(draws["from_constant"], draws["effect"][:, school])
    np.testing.assert_array_equal(draws["from_input"], draws["effect"][:, school])
    np.testing.assert_array_equal(draws["first"], draws["effect"][:, 0])
    picked = np.take_along_axis(draws["effect"], draws["best"], axis=1)
    np.testing.assert_allclose(draws["total"], picked.sum(1), rtol=1e-12)
    with pytest.raises(ValueError, match=r"node 'from_input': .*index 3 is outside plate 'school'"):
        net.sample(2, rng=0, inputs={"which": [0, 1, 2, 3]})
    with pytest.raises(
        ValueError, match=r"node 'from_input': .*index -1 is outside plate 'school'"
    ):
        net.sample(2, rng=0, inputs={"which": [0, 1, 2, -1]})


def test_hierarchy_of_gathers():
    """region_of[school] then effect[region]: a gather by a gathered discrete parent."""
    net = bmc.BayesNet(plates={"region": 2, "school": 3, "pupil": 5})
    school = np.array([0, 1, 2, 0, 1])
    net.add("effect", bmc.Normal(0.0, 1.0), plates="region")
    net.add("region_of", bmc.DiscreteUniform(0, 1), plates="school")
    net.add(
        "score",
        lambda effect, region_of: effect[region_of[school]],
        plates="pupil",
    )
    draws = net.sample(7, rng=3)
    expected = np.take_along_axis(draws["effect"], draws["region_of"][:, school], axis=1)
    np.testing.assert_array_equal(draws["score"], expected)
