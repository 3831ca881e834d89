"""Reading and writing XMLBIF: odd spellings, every fault with its line, no entities, round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesmc.errors import FileFormatError
from bayesmc.io.bif import parse_bif, read_text
from bayesmc.io.record import TableNode
from bayesmc.io.xmlbif import format_xmlbif, parse_xmlbif
from tests.io.test_bif import NAMES, same

TINY = """<?xml version="1.0"?>
<!DOCTYPE BIF [
  <!ELEMENT BIF ( NETWORK )*> <!ATTLIST BIF VERSION CDATA #REQUIRED>
  <!ELEMENT TABLE (#PCDATA)>
]>
<BIF VERSION="0.3">
<NETWORK>
<NAME>tiny</NAME> <PROPERTY>author is a person</PROPERTY>
<VARIABLE TYPE="nature">
  <NAME>age</NAME>
  <OUTCOME>&lt;5</OUTCOME>
  <OUTCOME>5-12</OUTCOME>
  <OUTCOME>12+</OUTCOME>
  <PROPERTY>position = (1, 2)</PROPERTY>
</VARIABLE>
<VARIABLE TYPE="nature">
  <NAME>ill</NAME> <OUTCOME>yes</OUTCOME> <OUTCOME>no</OUTCOME>
</VARIABLE>
<DEFINITION>
  <FOR>age</FOR>
  <TABLE>2e-1 3.0E-1 .5</TABLE>
</DEFINITION>
<DEFINITION>
  <FOR>ill</FOR>
  <GIVEN>age</GIVEN>
  <TABLE>
    0.1 0.9 <!-- below 5 -->
    0.2 0.8
    0.3 0.7
  </TABLE>
</DEFINITION>
</NETWORK>
</BIF>
"""


def edited(*changes):
    text = TINY
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def check_tiny(nodes):
    age, ill = nodes
    assert (age.name, age.states, age.parents) == ("age", ("<5", "5-12", "12+"), ())
    np.testing.assert_array_equal(age.probs, [0.2, 0.3, 0.5])
    assert (ill.name, ill.states, ill.parents) == ("ill", ("yes", "no"), ("age",))
    np.testing.assert_array_equal(ill.probs, [[0.1, 0.9], [0.2, 0.8], [0.3, 0.7]])
    return age, ill


def test_reads_names_states_parents_and_tables():
    age, ill = check_tiny(parse_xmlbif(TINY))
    assert age.properties == ("position = (1, 2)",)
    assert not ill.probs.flags.writeable


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_bytes_are_decoded_as_declared(encoding):
    declared = TINY.replace("5-12", "été").replace(
        'version="1.0"', f'version="1.0" encoding="{encoding.removesuffix("-sig")}"'
    )
    age, _ = parse_xmlbif(declared.encode(encoding))
    assert age.states[1] == "été"


@pytest.mark.parametrize(
    "text",
    [
        TINY[TINY.index("<BIF") :].lower(),
        TINY.replace('<BIF VERSION="0.3">', '<BIF VERSION="0.3" xmlns="http://x.org/XMLBIF">'),
        TINY.replace("<FOR>", "<b:For>").replace("</FOR>", "</b:For>"),
        TINY.replace(' TYPE="nature"', ""),
        TINY.replace("nature", "Nature"),
        TINY[TINY.index("<BIF") :],
        "\ufeff" + TINY,
        TINY.replace("\n", "\r\n"),
    ],
    ids=["lower", "namespace", "prefix", "no type", "type", "no head", "mark", "crlf"],
)  # fmt: skip
def test_other_spellings_read_alike(text):
    check_tiny(parse_xmlbif(text))


def test_definitions_may_precede_their_variables():
    start, end = TINY.index("<DEFINITION>"), TINY.index("</NETWORK>")
    first = TINY.index("<VARIABLE")
    text = TINY[:first] + TINY[start:end] + TINY[first:start] + TINY[end:]
    check_tiny(parse_xmlbif(text))


def test_a_comment_separates_numbers_and_names_lose_blanks():
    text = edited(("0.2 0.8", "0.2<!-- no, -0.7 -->0.8"), ("<FOR>ill</FOR>", "<FOR>\n ill\t</FOR>"))
    check_tiny(parse_xmlbif(text))


def test_the_first_given_is_slowest_and_the_outcomes_are_fastest():
    more = """<VARIABLE><NAME>x</NAME><OUTCOME>a</OUTCOME><OUTCOME>b</OUTCOME></VARIABLE>
    <DEFINITION><FOR>x</FOR><GIVEN>ill</GIVEN><GIVEN>age</GIVEN>
    <TABLE>0 1  .1 .9  .2 .8   .3 .7  .4 .6  .5 .5</TABLE></DEFINITION></NETWORK>"""
    probs = parse_xmlbif(edited(("</NETWORK>", more)))[2].probs
    assert probs.shape == (2, 3, 2)
    np.testing.assert_array_equal(probs[..., 0], [[0, 0.1, 0.2], [0.3, 0.4, 0.5]])


def test_small_rounding_is_renormalised():
    probs = parse_xmlbif(edited((".5</TABLE>", ".500001</TABLE>")))[0].probs
    np.testing.assert_allclose(probs, np.array([0.2, 0.3, 0.500001]) / 1.000001, rtol=1e-15)
    with pytest.raises(FileFormatError, match=r"f.xml:21: .*sums to 1\.000002, not 1"):
        parse_xmlbif(edited((".5</TABLE>", ".500002</TABLE>")), "f.xml")


FAULTS = {
    "unclosed": (("</NETWORK>", ""), 33, "malformed XML: mismatched tag"),
    "truncated": (("</BIF>\n", ""), 33, "malformed XML: no element found"),
    "bare ampersand": (("5-12", "5 & 12"), 12, "malformed XML: not well-formed"),
    "bare less": (("&lt;5", "<5"), 11, "malformed XML"),
    "other root": (("<BIF VERSION", "<XBIF VERSION"), 6, "'XBIF' at the top"),
    "unknown element": (("<OUTCOME>no</OUTCOME>", "<VALUE>no</VALUE>"), 17, "'VALUE' in VARIABLE"),
    "nested": (("5-12", "5<b>-</b>12"), 12, "'b' in OUTCOME, where XMLBIF 0.3 has text only"),
    "stray text": (("<GIVEN>age</GIVEN>", "age"), 25, "stray text in DEFINITION: 'age'"),
    "decision": (('<VARIABLE TYPE="nature">\n  <NAME>ill', '<VARIABLE TYPE="decision"><NAME>ill'),
                 16, "'ill' is of TYPE 'decision'"),
    "no name": (("  <NAME>ill</NAME>", ""), 16, "this VARIABLE has no NAME"),
    "empty name": (("<NAME>ill</NAME>", "<NAME> </NAME>"), 16, "has an empty NAME"),
    "two names": (("<NAME>ill</NAME>", "<NAME>a</NAME>\n<NAME>b</NAME>"), 18, "has 2 NAME"),
    "variable twice": (("<NAME>ill</NAME>", "<NAME>age</NAME>"), 16, "'age' is declared twice"),
    "no outcome": (("<OUTCOME>yes</OUTCOME> <OUTCOME>no</OUTCOME>", ""), 16, "has no OUTCOME"),
    "empty outcome": (("<OUTCOME>no</OUTCOME>", "<OUTCOME/>"), 17, "has an empty OUTCOME"),
    "outcome twice": (("12+", "5-12"), 13, "lists the outcome '5-12' twice"),
    "unknown parent": (("<GIVEN>age", "<GIVEN>old"), 25, "'old' is not a declared variable"),
    "unknown child": (("<FOR>ill", "<FOR>sick"), 24, "'sick' is not a declared variable"),
    "own parent": (("<GIVEN>age", "<GIVEN>ill"), 25, "'ill' is listed twice"),
    "parent twice": (("<GIVEN>age</GIVEN>", "<GIVEN>age</GIVEN>\n<GIVEN>age</GIVEN>"), 26, "twice"),
    "joint": (("<FOR>ill</FOR>", "<FOR>ill</FOR>\n<FOR>age</FOR>"), 25, "has 2 FOR; give one"),
    "no for": (("  <FOR>ill</FOR>\n", ""), 23, "this DEFINITION has no FOR"),
    "definition twice": (("<FOR>ill</FOR>", "<FOR>age</FOR>"), 23, "second DEFINITION; the first"),
    "no definition": (
        ("<DEFINITION>\n  <FOR>age</FOR>\n  <TABLE>2e-1 3.0E-1 .5</TABLE>\n</DEFINITION>\n", ""),
        9, "variable 'age' has no DEFINITION"),
    "no table": (("  <TABLE>2e-1 3.0E-1 .5</TABLE>\n", ""), 19, "'age' has no TABLE"),
    "too few": (("0.2 0.8", "0.2"), 26, r"expected 6 numbers \(3 x 2\), found 5"),
    "too many": ((".5</TABLE>", ".25 .25</TABLE>"), 21, r"expected 3 numbers \(3\), found 4"),
    "empty table": (("2e-1 3.0E-1 .5", ""), 21, "expected 3 numbers"),
    "not a number": (("0.2 0.8", "0.2\n oops"), 29, "'oops' is not a number"),
    "comma": (("0.2 0.8", "0.2, 0.8"), 28, "'0.2,' is not a number"),
    "underscore": (("0.2 0.8", "0.2 0_8"), 28, "'0_8' is not a number"),
    "negative": (("0.3 0.7", "1.3 -0.3"), 29, "1.3 is not a probability"),
    "nan": (("0.3 0.7", "0.3 nan"), 29, "nan is not a probability"),
    "infinite": (("0.3 0.7", "0.3\ninf"), 30, "inf is not a probability"),
    "row sum": (("0.3 0.7", "0.3 0.6"), 29, "a row sums to 0.9, not 1"),
    "no network": ((TINY[TINY.index("<NETWORK>") : TINY.index("</BIF>")], ""), 6, "no NETWORK"),
    "two networks": (("</BIF>", "<NETWORK/></BIF>"), 33, "2 NETWORK; give one"),
    "encoding": (('version="1.0"?', 'version="1.0" encoding="klingon"?'), 1, "encoding"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_name_file_and_line(fault):
    change, line, message = FAULTS[fault]
    with pytest.raises(FileFormatError, match=message) as caught:
        parse_xmlbif(edited(change).encode(), "net.xml")
    assert (caught.value.path, caught.value.line) == ("net.xml", line)
    assert str(caught.value).startswith(f"net.xml:{line}: ")


def test_every_truncation_is_an_error():
    whole = TINY.rstrip()
    for end in range(len(whole)):
        with pytest.raises(FileFormatError) as caught:
            parse_xmlbif(whole[:end])
        assert 1 <= caught.value.line <= whole.count("\n", 0, end) + 1


@pytest.mark.parametrize(
    "declarations",
    [
        '<!ENTITY a "&#48;.3">',
        '<!ENTITY a SYSTEM "file:///etc/hostname">',
        '<!ENTITY % a SYSTEM "file:///etc/hostname"> %a;',
        '<!ENTITY a "x"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;">',
    ],
    ids=["internal", "external", "parameter", "bomb"],
)
def test_entities_are_refused(declarations):
    text = edited(("]>", declarations + "]>")).replace("3.0E-1", "&a;")
    with pytest.raises(FileFormatError, match="the entity 'a' is declared; bayesmc reads no"):
        parse_xmlbif(text)


def test_an_external_document_type_is_not_opened(tmp_path):
    (tmp_path / "x.dtd").write_text('<!ENTITY five "0.5">')
    head = f'<!DOCTYPE BIF SYSTEM "{(tmp_path / "x.dtd").as_uri()}">\n'
    body = TINY[TINY.index("<BIF") :]
    check_tiny(parse_xmlbif(head + body))
    with pytest.raises(FileFormatError, match="the entity '&five;' is not defined"):
        parse_xmlbif(head + body.replace(" .5<", " &five;<"))


names = st.text(
    st.characters(exclude_categories=("C",), include_characters="\t\n\r<>&\"'"),
    min_size=1, max_size=8,
).filter(lambda name: name == name.strip(" \t\r\n"))  # fmt: skip


@st.composite
def table_nodes(draw):
    labels = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    nodes = []
    for k, name in enumerate(labels):
        states = tuple(draw(st.lists(names, min_size=1, max_size=3, unique=True)))
        parents = [node for node in nodes[:k] if draw(st.booleans())]
        shape = [len(p.states) for p in parents] + [len(states)]
        probs = rng.dirichlet(np.full(len(states), 0.3), size=shape[:-1])
        properties = tuple(draw(st.lists(names, max_size=2)))
        nodes.append(TableNode(name, states, tuple(p.name for p in parents), probs, properties))
    return nodes


@given(table_nodes())
def test_round_trip_of_any_names(nodes):
    text = format_xmlbif(nodes)
    assert all(map(same, parse_xmlbif(text), nodes))
    assert all(map(same, parse_xmlbif(text.encode()), nodes))


@pytest.mark.parametrize("name", ["", " a", "a\n", "a\x00b", "\x1f", "\ufffe", "\ud800"])
def test_names_without_a_spelling_are_refused(name):
    with pytest.raises(ValueError, match="no spelling for the name"):
        format_xmlbif([TableNode("x", ("a", name), (), np.array([0.5, 0.5]))])


@pytest.mark.parametrize("name", NAMES)
def test_reference_networks_round_trip(reference_data, name):
    path = reference_data / "bn_discrete" / "bif" / f"{name}.bif.gz"
    nodes = parse_bif(read_text(path), path)
    assert all(map(same, parse_xmlbif(format_xmlbif(nodes)), nodes))
