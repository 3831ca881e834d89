"""Reading and writing BIF: odd spellings, every fault with its line, round trips, real files."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesmc.errors import FileFormatError
from bayesmc.io.bif import TableNode, format_bif, parse_bif, read_text

NAMES = ["alarm", "asia", "cancer", "earthquake", "hepar2", "mildew", "munin1", "pigs", "sachs",
         "survey", "water"]  # fmt: skip

TINY = """network tiny {
  property "author is a person";
}
variable age {
  type discrete [ 3 ] { <5, 5-12, 12+ };
  property position = (1, 2);
}
variable ill {
  type discrete [ 2 ] { yes, no };
}
probability ( age ) {
  table 0.2, 0.3, 0.5;
}
probability ( ill | age ) {
  (<5) 0.1, 0.9;
  (5-12) 0.2, 0.8;
  (12+) 0.3, 0.7;
}
"""


def edited(*changes):
    text = TINY
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def test_reads_names_states_parents_and_tables():
    age, ill = parse_bif(TINY)
    assert (age.name, age.states, age.parents) == ("age", ("<5", "5-12", "12+"), ())
    assert age.properties == ("position = (1, 2)",)
    np.testing.assert_array_equal(age.probs, [0.2, 0.3, 0.5])
    assert (ill.name, ill.states, ill.parents) == ("ill", ("yes", "no"), ("age",))
    np.testing.assert_array_equal(ill.probs, [[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])
    assert not ill.probs.flags.writeable


@pytest.mark.parametrize(
    "state",
    ["<=5", ">7.5", "5-12-", "13+", "a.b", "n/a", "x=1", "50%", "été", "-", "'q'", "a:b", "1"],
)
def test_odd_state_names(state):
    age, ill = parse_bif(TINY.replace("5-12", state))
    assert age.states[1] == state
    np.testing.assert_array_equal(ill.probs[1], [0.2, 0.8])


def test_quoted_names_keep_what_they_hold():
    quoted = '"5 to 12, {or} (so); // not | a comment"'
    age, ill = parse_bif(TINY.replace("5-12", quoted))
    assert age.states[1] == quoted.strip('"')
    np.testing.assert_array_equal(ill.probs[1], [0.2, 0.8])
    renamed = parse_bif(
        TINY.replace("variable age", 'variable "my age"')
        .replace("( age", '( "my age"')
        .replace("| age", '| "my age"')
    )
    assert renamed[1].parents == ("my age",)


def test_rows_may_come_in_any_order_and_over_several_lines():
    text = edited(("  (<5) 0.1, 0.9;\n", ""), ("0.3, 0.7;", "0.3,\n   0.7;\n ( <5 )\n0.1 0.9 ;"))
    np.testing.assert_array_equal(parse_bif(text)[1].probs, parse_bif(TINY)[1].probs)


def test_default_fills_missing_rows():
    text = edited(("  (<5) 0.1, 0.9;\n  (5-12) 0.2, 0.8;\n", "  default 0.4, 0.6;\n"))
    np.testing.assert_array_equal(parse_bif(text)[1].probs, [[0.4, 0.6], [0.4, 0.6], [0.3, 0.7]])


def test_table_with_parents_has_the_child_slowest():
    rows = TINY[TINY.index("  (<5)") :]
    text = TINY.replace(rows, "  table 0.1, 0.2, 0.3, 0.9, 0.8, 0.7;\n}\n")
    np.testing.assert_array_equal(parse_bif(text)[1].probs, parse_bif(TINY)[1].probs)


def test_two_parents_follow_their_order_in_the_block():
    text = (
        TINY
        + """variable x { type discrete[2] {a, b}; }
    probability ( x | ill, age ) {
      (no, 12+) 0.25, 0.75;
      default 1.0, 0.0;
    }"""
    )
    probs = parse_bif(text)[2].probs
    assert probs.shape == (2, 3, 2)
    np.testing.assert_array_equal(probs[1, 2], [0.25, 0.75])
    assert probs[..., 0].sum() == 5.25


def test_comments_and_properties_anywhere():
    text = edited(
        ("network tiny", "// a line { ( ;\n/* two\n lines } */ network tiny"),
        ("  (5-12)", '  property "a } in ; quotes";\n  // (5-12) 9, 9;\n  /* ; */ (5-12)'),
        ("table 0.2, 0.3", "table 0.2, /* no */ 0.3"),
        ("0.5;", "0.5;// closing"),
    )
    for a, b in zip(parse_bif(text), parse_bif(TINY), strict=True):
        np.testing.assert_array_equal(a.probs, b.probs)


def test_probability_blocks_may_precede_their_variables():
    head, tail = TINY[: TINY.index("probability")], TINY[TINY.index("probability") :]
    network, variables = head[: head.index("variable")], head[head.index("variable") :]
    nodes = parse_bif(network + tail + variables)
    assert [node.name for node in nodes] == ["age", "ill"]


def test_small_rounding_is_renormalised_and_exact_rows_are_left_alone():
    probs = parse_bif(edited(("0.2, 0.3, 0.5", "0.2, 0.3, 0.500001")))[0].probs
    np.testing.assert_allclose(probs, np.array([0.2, 0.3, 0.500001]) / 1.000001, rtol=1e-15)
    below = parse_bif(edited(("0.2, 0.3, 0.5", "0.2, 0.3, 0.499999")))[0].probs
    assert below.sum() == pytest.approx(1.0, abs=1e-15)
    with pytest.raises(FileFormatError, match=r"12: .*sums to 1\.000002, not 1"):
        parse_bif(edited(("0.2, 0.3, 0.5", "0.2, 0.3, 0.500002")), "f.bif")


FAULTS = {
    "unknown parent": (("( ill | age )", "( ill | old )"), 14, "'old' is not a declared variable"),
    "unknown child": (("( ill | age )", "( sick | age )"), 14, "'sick' is not a declared"),
    "unknown state": (
        ("(5-12) 0.2", "(5-13) 0.2"),
        16,
        "'5-13' is not a state of its parent 'age'",
    ),
    "too many states": (("(5-12) 0.2", "(5-12, yes) 0.2"), 16, "names 2 states for 1 parents"),
    "missing row": (("  (5-12) 0.2, 0.8;\n", ""), 14, r"1 of 3 rows are missing, first \(5-12\)"),
    "row twice": (("(5-12) 0.2", "(<5) 0.2"), 16, r"row \(<5\) is given twice"),
    "too few numbers": (("0.2, 0.8;", "0.2;"), 16, "expected 2 numbers, found 1"),
    "too many numbers": (("0.2, 0.8;", "0.2, 0.4, 0.4;"), 16, "expected 2 numbers, found 3"),
    "no numbers": (("0.2, 0.8;", ";"), 16, "expected 2 numbers, found 0"),
    "table too short": (("0.2, 0.3, 0.5", "0.5, 0.5"), 12, "expected 3 numbers, found 2"),
    "negative": (("0.2, 0.8;", "1.2, -0.2;"), 16, "1.2 is not a probability"),
    "negative below one": (("0.2, 0.8;", "-0.2,\n 0.8;"), 16, "-0.2 is not a probability"),
    "not a number": (("0.2, 0.8;", "0.2,\n  oops;"), 17, "'oops' is not a number"),
    "underscore": (("0.2, 0.8;", "0.2, 0_8;"), 16, "'0_8' is not a number"),
    "nan": (("0.2, 0.8;", "0.2, nan;"), 16, "nan is not a probability"),
    "infinite": (("0.2, 0.8;", "0.2, inf;"), 16, "inf is not a probability"),
    "row sum": (("0.2, 0.8;", "0.2, 0.7;"), 16, "a row sums to 0.9, not 1"),
    "no block": (
        ("probability ( age ) {\n  table 0.2, 0.3, 0.5;\n}\n", ""),
        4,
        "'age' has no probability",
    ),
    "block twice": (("( ill | age )", "( age )"), 14, "'age' has a second probability block"),
    "variable twice": (("variable ill", "variable age"), 8, "'age' is declared twice"),
    "own parent": (("( ill | age )", "( ill | ill )"), 14, "listed twice in its scope"),
    "state twice": (("{ yes, no }", "{ yes, yes }"), 9, "lists a state twice: yes, yes"),
    "count of states": (("[ 2 ]", "[ 3 ]"), 9, "announces 3 states and lists 2"),
    "space in a state": (("{ yes, no }", "{ yes, oh no }"), 9, "needs double quotes"),
    "no type": (("  type discrete [ 2 ] { yes, no };\n", ""), 8, "has no 'type discrete"),
    "continuous": (("discrete [ 2 ]", "continuous [ 2 ]"), 9, "expected 'discrete"),
    "table and rows": (("  (<5) 0.1", "  table 0.1,0.1,0.1,0.9,0.9,0.9;\n  (<5) 0.1"), 15, "mixes"),
    "stray word": (("probability ( age )", "oops ( age )"), 11, "found 'oops'"),
    "stray row word": (("  (5-12) 0.2", "  rows (5-12) 0.2"), 16, "found 'rows'"),
    "unclosed row": (("(5-12) 0.2", "(5-12 0.2"), 16, r"expected '\(states\) numbers;'"),
    "empty scope": (("( ill | age )", "( )"), 14, "'' is not a declared variable"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_name_file_and_line(fault):
    change, line, message = FAULTS[fault]
    with pytest.raises(FileFormatError, match=message) as caught:
        parse_bif(edited(change), "net.bif")
    assert (caught.value.path, caught.value.line) == ("net.bif", line)
    assert str(caught.value).startswith(f"net.bif:{line}: ")


def test_every_truncation_is_an_error():
    whole = TINY.rstrip()
    complete = {whole.index("\nvariable") + 1, 0, 1}
    for end in range(2, len(whole)):
        if (
            not whole[:end].strip()
            or end in complete
            or whole[:end].rstrip().endswith('person";\n}')
        ):
            continue
        with pytest.raises(FileFormatError) as caught:
            parse_bif(whole[:end])
        assert 1 <= caught.value.line <= whole.count("\n", 0, end) + 1


def test_an_error_without_a_path_still_has_its_line():
    with pytest.raises(FileFormatError) as caught:
        parse_bif(edited(("0.2, 0.8;", "0.2;")))
    assert caught.value.path is None and caught.value.line == 16


def same(a, b):
    return (
        (a.name, a.states, a.parents, a.properties) == (b.name, b.states, b.parents, b.properties)
        and a.probs.shape == b.probs.shape
        and (a.probs == b.probs).all()
    )


names = st.text(
    st.characters(exclude_characters='"\n\r', exclude_categories=("C", "Zl", "Zp")),
    min_size=1, max_size=8,
)  # fmt: skip


@st.composite
def bif_nodes(draw):
    labels = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    nodes = []
    for k, name in enumerate(labels):
        states = tuple(draw(st.lists(names, min_size=1, max_size=3, unique=True)))
        parents = [node for node in nodes[:k] if draw(st.booleans())]
        shape = [len(p.states) for p in parents] + [len(states)]
        probs = rng.dirichlet(np.full(len(states), 0.3), size=shape[:-1])
        nodes.append(TableNode(name, states, tuple(p.name for p in parents), probs))
    return nodes


@given(bif_nodes())
def test_round_trip_of_any_names(nodes):
    assert all(map(same, parse_bif(format_bif(nodes)), nodes))


def test_round_trip_keeps_properties():
    assert all(map(same, parse_bif(format_bif(parse_bif(TINY))), parse_bif(TINY)))


@pytest.mark.parametrize("name", ['a"b', "a\nb"])
def test_names_without_a_spelling_are_refused(name):
    with pytest.raises(ValueError, match="no spelling for the name"):
        format_bif([TableNode(name, ("a",), (), np.ones(1))])


def test_read_text_takes_plain_and_gzipped_files(tmp_path):
    (tmp_path / "a.bif").write_text(TINY, encoding="utf-8")
    (tmp_path / "b.bif.gz").write_bytes(gzip.compress(TINY.encode()))
    assert read_text(tmp_path / "a.bif") == read_text(str(tmp_path / "b.bif.gz")) == TINY


@pytest.mark.parametrize("damage", ["cut", "garbled", "latin"])
def test_read_text_refuses_damaged_files(tmp_path, damage):
    data = gzip.compress(TINY.encode(), mtime=0)
    data = {
        "cut": data[:-20],
        "garbled": data[:12] + bytes(40) + data[52:],
        "latin": "été".encode("latin-1"),
    }[damage]
    path = tmp_path / "x.bif.gz"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match="not readable as") as caught:
        read_text(path)
    assert caught.value.path == path


@pytest.mark.parametrize("name", NAMES)
def test_reference_networks_load_and_round_trip(reference_data, name):
    path = reference_data / "bn_discrete" / "bif" / f"{name}.bif.gz"
    nodes = parse_bif(read_text(path), path)
    with gzip.open(reference_data / "bn_discrete" / "refs" / f"{name}.ref.json.gz", "rt") as file:
        expected = json.load(file)
    assert len(nodes) == expected["nodes"]
    assert sum(len(node.parents) for node in nodes) == expected["arcs"]
    free = sum(node.probs.size // len(node.states) * (len(node.states) - 1) for node in nodes)
    assert free == expected["free_params"]
    assert sum(int((node.probs == 0).sum()) for node in nodes) == expected["zero_cpt_entries"]
    for node in nodes:
        np.testing.assert_allclose(node.probs.sum(axis=-1), 1.0, rtol=0, atol=1e-12)
    assert all(map(same, parse_bif(format_bif(nodes)), nodes))
