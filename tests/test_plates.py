"""Parents with foreign plates: gathers, reductions and ufuncs against loops over single elements."""

from __future__ import annotations

import copy
import itertools

import numpy as np
import pytest
import scipy.special
from hypothesis import given, settings
from hypothesis import strategies as st

import bayesmc as bmc
from bayesmc.errors import PlateError
from bayesmc.plates import Gathered, PlateArray
from bayesmc.states import StateArray
from bayesmc.testing import session

OWN = "ij"  # the child's own plates, in its order
FOREIGN = "abc"
BATCHES = ((), (1,), (2,), (3,), (2, 3), (2, 1), (1, 3))  # every pair broadcasts or is rejected


@st.composite
def layouts(draw, operands: int, event: tuple[int, ...] = ()):
    """Sizes (which collide often), and a batch, shared plates and foreign order per operand."""
    sizes = {p: draw(st.sampled_from((1, 2, 3))) for p in OWN + FOREIGN}
    batch = draw(st.sampled_from(((), (2,), (3, 2))))
    parts = []
    for _ in range(operands):
        keep = draw(st.integers(0, len(batch)))
        own_batch = tuple(n if draw(st.booleans()) else 1 for n in batch[len(batch) - keep :])
        shared = tuple(p for p in OWN if draw(st.booleans()))
        order = draw(st.permutations(FOREIGN))
        foreign = tuple(order[: draw(st.integers(1, 3))])
        parts.append((own_batch, shared, foreign))
    return sizes, batch, parts


def operand(rng, sizes, part, event=(), values=None):
    """A parent as a child in plates i, j receives it."""
    batch, shared, foreign = part
    shape = batch + tuple(sizes[p] if p in shared else 1 for p in OWN)
    shape += tuple(sizes[p] for p in foreign) + event
    array = rng.normal(size=shape) if values is None else rng.integers(0, values, size=shape)
    return PlateArray(array, foreign, own=len(OWN), event_ndim=len(event))


def at(x, where, batch_index):
    """One element of an operand, by plate name: the slow, obvious way."""
    if not isinstance(x, PlateArray):
        return x
    lead = x.array.ndim - len(OWN) - len(x.plates) - x.event_ndim
    shape = x.array.shape
    full = tuple(batch_index[len(batch_index) - lead :]) if lead else ()
    full += tuple(where[p] for p in OWN) + tuple(where[p] for p in x.plates)
    return x.array[tuple(i if n > 1 else 0 for i, n in zip(full, shape, strict=False))]


def elements(sizes, names):
    for index in itertools.product(*(range(sizes[p]) for p in names)):
        yield dict(zip(names, index, strict=True))


def assert_elementwise(result, reference, sizes, batch, foreign):
    """``result`` (a PlateArray over ``foreign``, or an array) equals ``reference(where, b)``."""
    if foreign:
        assert set(result.plates) == set(foreign)
        array, names = result.array, result.plates
        event = result.event_ndim
    else:
        array, names, event = np.asarray(result), (), None
    probe = np.asarray(reference(next(elements(sizes, OWN + FOREIGN)), (0,) * len(batch)))
    event = probe.ndim
    full = batch + tuple(sizes[p] for p in OWN) + tuple(sizes[p] for p in names) + probe.shape
    if foreign:
        assert result.event_ndim == event
    array = np.broadcast_to(array, full)
    for b in np.ndindex(batch):
        for where in elements(sizes, (*OWN, *names)):
            got = array[(*b, *(where[p] for p in (*OWN, *names)))]
            np.testing.assert_allclose(got, reference(where, b), rtol=1e-12, atol=1e-12)


# ---- gathers against loops ----------------------------------------------------------------------


@given(layouts(1), st.data())
def test_gather_by_own_indices_is_the_loop(layout, data):
    """v[i], v[i, j], v[:, j]: any foreign order, shared plates, mixed batch ranks, equal sizes."""
    sizes, batch, (part,) = layout
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    event = data.draw(st.sampled_from(((), (2,), (3, 2))))
    v = operand(rng, sizes, part, event)
    taken = [data.draw(st.booleans()) for _ in v.plates]
    taken[data.draw(st.integers(0, len(taken) - 1))] = True
    keys, indices = [], {}
    for plate, take in zip(v.plates, taken, strict=True):
        if not take:
            keys.append(slice(None))
            continue
        keep = data.draw(st.integers(0, len(batch)))
        shape = batch[len(batch) - keep :] + tuple(
            sizes[p] if data.draw(st.booleans()) else 1 for p in OWN
        )
        indices[plate] = rng.integers(0, sizes[plate], size=shape)
        keys.append(indices[plate])
    while keys and isinstance(keys[-1], slice):
        keys.pop()  # v[i] leaves later plates alone
    result = v[tuple(keys)] if len(keys) > 1 else v[keys[0]]
    kept = [p for p, take in zip(v.plates, taken, strict=True) if not take]

    def reference(where, b):
        places = dict(where)
        for plate, index in indices.items():
            full = (*b, *(where[p] for p in OWN))[len(batch) + len(OWN) - index.ndim :]
            places[plate] = index[
                tuple(i if n > 1 else 0 for i, n in zip(full, index.shape, strict=True))
            ]
        return at(v, places, b)

    assert_elementwise(result, reference, sizes, batch, kept)


@given(layouts(2), st.data())
def test_gather_by_a_foreign_parent_is_the_loop(layout, data):
    """``v[label]`` where the label lives in plates the child lacks, some of which v has too."""
    sizes, batch, (part, index_part) = layout
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    v = operand(rng, sizes, part, data.draw(st.sampled_from(((), (2,)))))
    gathered = v.plates[0]
    index_foreign = tuple(p for p in index_part[2] if p != gathered)
    if not index_foreign:
        index_foreign = tuple(p for p in FOREIGN if p != gathered)
    index = operand(rng, sizes, (*index_part[:2], index_foreign), values=sizes[gathered])
    left = set(v.plates[1:]) | set(index.plates)

    def reference(where, b):
        return at(v, {**where, gathered: int(at(index, where, b))}, b)

    assert_elementwise(v[index], reference, sizes, batch, left)


def test_gather_by_a_parent_in_the_gathered_plate_itself():
    v = PlateArray(np.array([10.0, 20.0, 30.0]), ("a",))
    parent = PlateArray(np.array([2, 2, 0]), ("a",))
    assert v[parent].array.tolist() == [30.0, 30.0, 10.0]


def test_gather_never_takes_the_batch_axis():
    """Batch, own plate and foreign plate all of size three: only names tell them apart."""
    rng = np.random.default_rng(0)
    v = PlateArray(rng.normal(size=(3, 1, 3)), ("k",), own=1)
    z = rng.integers(0, 3, size=(3, 3))
    expected = np.array([[v.array[b, 0, z[b, n]] for n in range(3)] for b in range(3)])
    np.testing.assert_array_equal(v[z], expected)
    assert not np.array_equal(v[z], v.array[:, 0][z[:, 0]])  # what fancy indexing would give


@pytest.mark.parametrize("index", [0, 2, np.int64(1), np.uint8(2), np.array(1), [0, 2, 1, 1]])
def test_gather_by_integers_and_constants(index):
    v = PlateArray(np.arange(6.0).reshape(2, 1, 3), ("k",), own=1)
    picked = np.broadcast_to(v[index], (2, 4))
    expected = np.arange(6.0).reshape(2, 3)[:, np.broadcast_to(index, 4)]
    np.testing.assert_array_equal(picked, expected)


def test_gather_of_labels_keeps_them():
    v = PlateArray(StateArray(np.array([[0, 1, 1]]), ("no", "yes")), ("k",), own=1)
    assert (v[np.array([1, 0])] == "yes").tolist() == [True, False]
    with pytest.raises(ValueError, match="'maybe' is not a state"):
        v[np.array([1, 0])] == "maybe"  # noqa: B015 - the comparison is the test


def test_gather_of_one_label_keeps_it():
    v = PlateArray(StateArray(np.array([0, 1, 1]), ("no", "yes")), ("k",))
    assert v[1] == "yes"


def test_labels_gather_by_position():
    v = PlateArray(np.array([[10.0, 20.0]]), ("k",), own=1)
    assert v[StateArray(np.array([1, 0, 1]), ("no", "yes"))].tolist() == [20.0, 10.0, 20.0]


def test_components_before_and_after_a_gather():
    rng = np.random.default_rng(1)
    table = rng.normal(size=(5, 1, 3, 4))
    v = PlateArray(table, ("k",), own=1, event_ndim=1)
    z = rng.integers(0, 3, size=(5, 2))
    rows = np.take_along_axis(table, z[:, :, None, None], axis=2)[:, :, 0]
    assert rows.shape == (5, 2, 4)
    for picked in (v[z], v[z][...], v[z, ...]):
        np.testing.assert_array_equal(picked, rows)
    np.testing.assert_array_equal(v[..., 2][z], rows[..., 2])
    np.testing.assert_array_equal(v[z, ..., 2], rows[..., 2])
    np.testing.assert_array_equal(v[..., 1:3][z], rows[..., 1:3])
    np.testing.assert_array_equal(v[z][..., 2], rows[..., 2])
    assert v[...].plates == v[:].plates == ("k",)


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (-1, r"index -1 is outside plate 'k', whose positions are 0\.\.2"),
        (3, r"index 3 is outside plate 'k', whose positions are 0\.\.2"),
        ([0, -2], r"index -2 is outside plate 'k'"),
        (np.array([0, 7]), r"index 7 is outside plate 'k'"),
        (1.0, r"plate 'k' is gathered by integers 0\.\.2 .* not by float64"),
        ("x", r"plate 'k' is gathered by integers 0\.\.2"),
        (None, r"plate 'k' is gathered by integers 0\.\.2"),
        (np.array([True, False, True]), r"plate 'k' is gathered by integers 0\.\.2 .* not by bool"),
        (slice(1, None), r"only the full slice : keeps a foreign plate; gather elements by index"),
        (
            (0, 0),
            r"2 indices for the foreign plates .* components of a vector are taken with v\[\.\.\., k\]",
        ),
        (
            (Ellipsis, 0),
            r"takes components of the event \(0 axes here\).*gather along plates .* with v\[i\]",
        ),
    ],
)
def test_gather_refuses(key, message):
    v = PlateArray(np.arange(3.0), ("k",))
    with pytest.raises(IndexError, match=message):
        v[key]


def test_a_vector_is_no_index():
    v = PlateArray(np.arange(3.0), ("k",))
    with pytest.raises(IndexError):
        v[PlateArray(np.zeros((2, 4), dtype=int), ("j",), event_ndim=1)]


def test_gather_from_and_into_an_empty_plate():
    v = PlateArray(np.empty((2, 1, 0)), ("k",), own=1)
    assert v[np.empty((2, 0), dtype=int)].shape == (2, 0)
    assert PlateArray(np.ones((2, 1, 3)), ("k",), own=1)[np.empty((2, 0), int)].shape == (2, 0)
    with pytest.raises(IndexError, match="outside plate 'k'"):
        v[0]


# ---- ufuncs and reductions ----------------------------------------------------------------------


@given(layouts(3), st.data())
@settings(max_examples=session.scaled(40, 5))
def test_ufuncs_align_foreign_plates_by_name(layout, data):
    sizes, batch, parts = layout
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    x, y = (operand(rng, sizes, part) for part in parts[:2])
    # a plain operand is a value of the child itself
    own = PlateArray(rng.normal(size=parts[2][0] + tuple(sizes[p] for p in OWN)), (), own=len(OWN))
    foreign = set(x.plates) | set(y.plates)

    def reference(where, b):
        return np.exp(at(x, where, b)) * at(y, where, b) - 2 * at(own, where, b)

    assert_elementwise(np.exp(x) * y - 2 * own.array, reference, sizes, batch, foreign)
    swapped = -(2 * own.array) + y * np.exp(x)
    assert_elementwise(swapped, reference, sizes, batch, foreign)

    def chosen(where, b):
        return at(x, where, b) if at(y, where, b) > 0 else at(own, where, b)

    assert_elementwise(np.where(y > 0, x, own.array), chosen, sizes, batch, foreign)


@given(layouts(2), st.data())
@settings(max_examples=session.scaled(40, 5))
def test_generalised_ufuncs_keep_their_core(layout, data):
    """np.vecdot and np.matvec with own, foreign and constant operands."""
    sizes, batch, parts = layout
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    x, y = (operand(rng, sizes, part, (2,)) for part in parts)
    matrix = operand(rng, sizes, parts[1], (3, 2))
    design = rng.normal(size=(*(sizes[p] for p in OWN), 2))
    both = set(x.plates) | set(y.plates)

    assert_elementwise(np.vecdot(x, y), lambda w, b: at(x, w, b) @ at(y, w, b), sizes, batch, both)
    assert_elementwise(
        np.matvec(matrix, x), lambda w, b: at(matrix, w, b) @ at(x, w, b), sizes, batch, both
    )
    assert_elementwise(
        np.vecdot(design, x),
        lambda w, b: design[tuple(w[p] for p in OWN)] @ at(x, w, b),
        sizes,
        batch,
        set(x.plates),
    )
    assert_elementwise(
        np.matvec(np.array([[1.0, 2.0], [0.0, 1.0]]), x),
        lambda w, b: np.array([[1.0, 2.0], [0.0, 1.0]]) @ at(x, w, b),
        sizes,
        batch,
        set(x.plates),
    )


@given(layouts(1), st.data())
@settings(max_examples=session.scaled(60, 5))
def test_reductions_are_the_loop(layout, data):
    sizes, batch, (part,) = layout
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    v = operand(rng, sizes, part, data.draw(st.sampled_from(((), (2,)))))
    names = [p for p in v.plates if data.draw(st.booleans())]
    gone = names or list(v.plates)
    for kind in ("sum", "mean", "prod", "max", "min"):

        def reference(where, b, kind=kind):
            parts = [at(v, {**where, **more}, b) for more in elements(sizes, gone)]
            return getattr(np, kind)(np.stack(parts), axis=0)

        result = getattr(v, kind)(*names)
        assert_elementwise(result, reference, sizes, batch, set(v.plates) - set(gone))
    positive = v > 0
    for kind in ("any", "all"):

        def truth(where, b, kind=kind):
            parts = [at(positive, {**where, **more}, b) for more in elements(sizes, gone)]
            return getattr(np, kind)(np.stack(parts), axis=0)

        assert_elementwise(
            getattr(positive, kind)(*names), truth, sizes, batch, set(v.plates) - set(gone)
        )


def test_gather_of_arithmetic_and_arithmetic_of_gathers_agree():
    rng = np.random.default_rng(3)
    a = PlateArray(rng.normal(size=(4, 1, 3)), ("k",), own=1)
    b = PlateArray(rng.normal(size=(1, 3)), ("k",), own=1)
    z = rng.integers(0, 3, size=(4, 5))
    np.testing.assert_allclose((a + np.exp(b))[z], a[z] + np.exp(b[z]), rtol=1e-14)


def test_comparison_with_labels_over_foreign_plates():
    z = PlateArray(StateArray(np.array([[0, 1, 1]]), ("no", "yes")), ("p",), own=1)
    assert (z == "yes").sum("p").tolist() == [2]
    assert (z != "yes").sum("p").tolist() == [1]
    x = PlateArray(np.array([[1.0, 2.0, 4.0]]), ("p",), own=1)
    assert np.where(z == "yes", x, 0.0).sum("p").tolist() == [6.0]
    with pytest.raises(ValueError, match="'yep' is not a state; the states are 'no', 'yes'"):
        z == "yep"  # noqa: B015


def test_other_ufuncs_and_clip():
    v = PlateArray(np.array([[-1.5, 0.5, 2.5]]), ("k",), own=1)
    assert scipy.special.expit(v).array.shape == (1, 3)
    assert np.clip(v, 0.0, 1.0).array.tolist() == [[0.0, 0.5, 1.0]]
    whole, part = divmod(v, 1.0)
    assert whole.plates == part.plates == ("k",)
    np.testing.assert_allclose((whole + part).array, v.array)
    assert (abs(-v) ** 2).array.tolist() == [[2.25, 0.25, 6.25]]
    assert (1.0 < v).array.tolist() == [[False, False, True]]
    assert v.sizes == {"k": 3} and "k: 3" in repr(v)


def test_clip_with_one_bound():
    v = PlateArray(np.array([-1.5, 0.5]), ("k",))
    assert np.clip(v, 0.0, None).array.tolist() == [0.0, 0.5]


# ---- ungathered use -----------------------------------------------------------------------------

UNGATHERED = {
    "bool": bool,
    "float": float,
    "int": int,
    "len": len,
    "iterate": list,
    "range": range,
    "max": max,
    "in": lambda v: 1.0 in v,
    "if": lambda v: 1 if v > 0 else 0,
    "asarray": np.asarray,
    "array": np.array,
    "logsumexp": scipy.special.logsumexp,
    "sum of a loop": lambda v: sum(x for x in v),
}


@pytest.mark.parametrize("use", UNGATHERED.values(), ids=UNGATHERED)
def test_ungathered_use_says_what_to_do(use):
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    with pytest.raises(
        PlateError,
        match=r"'k', which the child lacks, is used ungathered; pick elements "
        r"with v\[index\], reduce with v\.sum\('k'\) .*v\.array",
    ):
        use(v)


MIXING = {
    "np.sum": np.sum,
    "np.mean": np.mean,
    "np.cumsum": np.cumsum,
    "np.sort": np.sort,
    "np.dot": lambda v: np.dot(v, v),
    "np.stack": lambda v: np.stack([v, v]),
    "np.concatenate": lambda v: np.concatenate([v, v]),
    "np.linalg.norm": np.linalg.norm,
    "np.einsum": lambda v: np.einsum("i,i", v, v),
}


@pytest.mark.parametrize("use", MIXING.values(), ids=MIXING)
def test_numpy_functions_that_would_mix_say_what_to_do(use):
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    with pytest.raises(
        TypeError, match=r"foreign plates .*'k'.*gather with v\[i\], reduce with \.sum\('k'\)"
    ):
        use(v)


@pytest.mark.parametrize("method", ["reduce", "accumulate"])
def test_ufunc_methods_say_what_to_do(method):
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    with pytest.raises(
        TypeError, match=rf"np\.add\.{method} would mix .* reduce with \.sum\('k'\) or gather"
    ):
        getattr(np.add, method)(v)


def test_matmul_points_at_vecdot_and_matvec():
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    for use in (lambda: v @ v, lambda: np.ones(3) @ v, lambda: v @ np.ones(3)):
        with pytest.raises(
            TypeError, match=r"np\.vecdot\(X, v\) or np\.matvec\(A, v\) instead of @"
        ):
            use()


def test_ufunc_options_that_bypass_alignment_are_refused():
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    with pytest.raises(TypeError, match=r"np\.exp on a parent with foreign plates takes no where="):
        np.exp(v, where=True)
    target = np.zeros(3)
    with pytest.raises(ValueError, match="read-only"):
        np.exp(v, out=target)
    assert not target.any()


def test_in_place_arithmetic_is_refused_with_the_remedy():
    v = PlateArray(np.array([1.0, 2.0, 3.0]), ("k",))
    with pytest.raises(ValueError, match=r"a parent is read-only; write v = v \+ 1"):
        v += 1
    assert v.array.tolist() == [1.0, 2.0, 3.0]


def test_reducing_an_unknown_plate_names_the_known_ones():
    v = PlateArray(np.ones((2, 3)), ("a", "b"))
    for call in (lambda: v.sum("c"), lambda: v.mean("a", "c"), lambda: v.max(0)):
        with pytest.raises(PlateError, match=r"the foreign plates here are \('a', 'b'\)"):
            call()


# ---- the lazy gather ----------------------------------------------------------------------------


def lazy(seed=0):
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.ones(4), size=(5, 3))[:, None]  # batch 5, own 1, plate 3, event 4
    z = rng.integers(0, 3, size=(5, 6))
    gathered = PlateArray(table, ("k",), own=1, event_ndim=1)[z]
    plain = np.array([[table[b, 0, z[b, n]] for n in range(6)] for b in range(5)])
    return gathered, plain


AS_ARRAY = {
    "log": np.log,
    "arithmetic": lambda g: 2.0 - g * 3.0 + g / 2.0,
    "negative": lambda g: -(abs(g) ** 2),
    "compare": lambda g: g > 0.2,
    "two": lambda g: g + g,
    "sum method": lambda g: g.sum(axis=-1),
    "np.sum": lambda g: np.sum(g, axis=-1),
    "normalise": lambda g: g / g.sum(axis=-1, keepdims=True),
    "max": lambda g: g.max(axis=-1),
    "argmax": lambda g: np.argmax(g, axis=-1),
    "cumsum": lambda g: np.cumsum(g, axis=-1),
    "component": lambda g: g[..., 1],
    "slice": lambda g: g[..., 1:3],
    "newaxis": lambda g: g[..., None, :],
    "ellipsis": lambda g: g[...],
    "where": lambda g: np.where(g > 0.2, g, 0.0),
    "vecdot": lambda g: np.vecdot(g, np.arange(4.0)),
    "vecdot twice": lambda g: np.vecdot(g, g),
    "matvec": lambda g: np.matvec(np.eye(4)[::-1], g),
    "matmul": lambda g: g @ np.eye(4)[::-1],
    "rmatmul": lambda g: np.eye(6) @ g,
    "einsum": lambda g: np.einsum("...i,...i->...", g, g),
    "stack": lambda g: np.stack([g, g], axis=-1),
    "concatenate": lambda g: np.concatenate([g, 1 - g], axis=-1),
    "bmc.stack": lambda g: bmc.stack([g, 1.0]),
    "expit": scipy.special.expit,
    "logsumexp": lambda g: scipy.special.logsumexp(g, axis=-1),
    "asarray": np.asarray,
    "as float32": lambda g: np.asarray(g, dtype=np.float32),
    "astype": lambda g: g.astype(np.float32),
    "reduce": lambda g: np.add.reduce(g, axis=-1),
    "transpose": lambda g: g.T,
    "reshape": lambda g: g.reshape(30, 4),
    "norm": lambda g: np.linalg.norm(g, axis=-1),
    "iterate": lambda g: np.array(list(g)),
    "len": len,
    "clip": lambda g: np.clip(g, 0.1, 0.5),
    "mean": lambda g: np.mean(g),
    "maximum": lambda g: np.maximum(g, 0.25),
    "shape": lambda g: (g.shape, g.ndim, g.size, g.dtype, np.shape(g), np.ndim(g)),
}


@pytest.mark.parametrize("use", AS_ARRAY.values(), ids=AS_ARRAY)
def test_a_lazy_gather_is_an_array_for_every_purpose(use):
    gathered, plain = lazy()
    assert isinstance(gathered, Gathered)
    result, expected = use(gathered), use(plain)
    if isinstance(expected, tuple):
        assert result == expected
    else:
        assert type(result) is type(expected)
        np.testing.assert_array_equal(result, expected)


def test_a_lazy_gather_cannot_be_written_to():
    gathered, _ = lazy()
    with pytest.raises(ValueError, match="read-only"):
        np.asarray(gathered)[...] = 0.0
    with pytest.raises(TypeError):
        gathered[..., 0] = 0.0


def test_a_copy_of_a_lazy_gather_is_the_users_own():
    gathered, plain = lazy()
    mine = np.array(gathered)
    mine[...] = 0.0
    np.testing.assert_array_equal(np.asarray(gathered), plain)


def test_in_place_arithmetic_on_a_lazy_gather_is_refused():
    gathered, plain = lazy()
    name = gathered
    with pytest.raises(ValueError, match="read-only"):
        name += 1.0
    np.testing.assert_array_equal(np.asarray(gathered), plain)


def test_copies_of_a_lazy_gather():
    gathered, plain = lazy()
    for twin in (copy.copy(gathered), copy.deepcopy(gathered)):
        np.testing.assert_array_equal(np.asarray(twin), plain)


def test_distributions_take_a_lazy_gather():
    gathered, plain = lazy()
    x = np.tile(np.arange(6) % 4, (5, 1))
    np.testing.assert_allclose(
        bmc.Categorical(gathered).log_prob(x), bmc.Categorical(plain).log_prob(x), rtol=1e-13
    )
    np.testing.assert_allclose(
        bmc.Categorical(logits=np.log(gathered)).log_prob(x),
        bmc.Categorical(plain).log_prob(x),
        rtol=1e-12,
    )
    np.testing.assert_allclose(
        bmc.Categorical(logits=gathered).log_prob(x), bmc.Categorical(logits=plain).log_prob(x)
    )
    v = np.full(4, 0.25)
    np.testing.assert_array_equal(
        bmc.Dirichlet(gathered + 0.5).log_prob(v), bmc.Dirichlet(plain + 0.5).log_prob(v)
    )
    np.testing.assert_array_equal(
        bmc.MvNormal(gathered, np.eye(4)).log_prob(v), bmc.MvNormal(plain, np.eye(4)).log_prob(v)
    )
    a = bmc.Categorical(gathered).sample(7)
    assert a.shape == (5, 6)
    np.testing.assert_array_equal(a, bmc.Categorical(plain).sample(7))


def test_categorical_never_materialises_a_gather(monkeypatch):
    """Neither density nor draws of Categorical(phi[z]) build the whole, in a net and outside."""
    built = []
    original = Gathered.__array__

    def counted(self, *args, **kwargs):
        built.append(self.shape)
        return original(self, *args, **kwargs)

    monkeypatch.setattr(Gathered, "__array__", counted)
    gathered, _ = lazy()
    dist = bmc.Categorical(gathered)
    dist.log_prob(np.zeros((5, 6), dtype=int))
    dist.sample(1)
    net = bmc.BayesNet(plates={"topic": 3, "token": 6})
    net.add("phi", bmc.Dirichlet(np.ones(50)), plates="topic")
    net.add("z", bmc.Categorical(np.ones(3) / 3), plates="token")
    net.add("word", lambda phi, z: bmc.Categorical(phi[z]), plates="token")
    draws = net.sample(11, rng=0)  # validates first, which may look at everything
    built.clear()
    net.log_prob(draws)
    net.sample(11, rng=0)
    assert built == []
    np.log(gathered)
    assert built  # the instrument sees what it should


# ---- stack --------------------------------------------------------------------------------------


def test_stack_broadcasts_batches_first():
    a, b = np.arange(6.0).reshape(3, 2), np.array([10.0, 20.0])
    stacked = bmc.stack([a, b, 1.0])
    assert stacked.shape == (3, 2, 3)
    for i in np.ndindex(3, 2):
        assert stacked[i].tolist() == [a[i], b[i[1]], 1.0]
    assert bmc.stack([a, b], axis=0).shape == (2, 3, 2)


@given(layouts(2), st.integers(0, 999))
@settings(max_examples=session.scaled(40, 5))
def test_stack_of_foreign_parents_makes_a_vector(layout, seed):
    sizes, batch, parts = layout
    rng = np.random.default_rng(seed)
    x, y = (operand(rng, sizes, part) for part in parts)
    result = bmc.stack([x, y, 1.0])
    assert_elementwise(
        result,
        lambda w, b: np.array([at(x, w, b), at(y, w, b), 1.0]),
        sizes,
        batch,
        set(x.plates) | set(y.plates),
    )
    with pytest.raises(TypeError, match="axis=-1 only"):
        bmc.stack([x, y], axis=0)
