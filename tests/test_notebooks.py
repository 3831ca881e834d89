"""What notebooks show is well-formed, says what is there, and takes no markup from names."""

from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.drawing.graph import Mark, graph
from bayesmc.drawing.html import band, table


class Balanced(HTMLParser):
    """Tags that are open; a closing tag that is not the last one opened is an error."""

    def __init__(self, text):
        super().__init__()
        self.open, self.text, self.tags = [], [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def shown(what) -> Balanced:
    text = what._repr_html_()
    for picture in text.split("<svg")[1:]:
        ElementTree.fromstring("<svg" + picture.partition("</svg>")[0] + "</svg>")
    assert "#000" not in text and "black" not in text and "white;" not in text
    return Balanced(text)


def radon() -> bmc.BayesNet:
    net = bmc.BayesNet("<i>radon</i>", plates={"county": ["<b>", "c & d"], "house": 3})
    net.input("floor", plates="house")
    net.input("county", plates="house")
    net.add("kind", bmc.Bernoulli(0.4), states=("<low>", "high"), plates="county")

    @net.node(plates="county")
    def level(kind):
        return bmc.Normal(kind == "high", 1.0)

    net.add("twice", lambda level: 2.0 * level, plates="county")

    @net.node(plates="house")
    def y(level, county, floor):
        return bmc.Normal(level[county] - floor, 1.0)

    net.potential("tied", lambda level: -(level.sum("county") ** 2))
    return net


DATA = {"floor": [0.0, 1.0, 0.0], "county": [0, 1, 1]}


def test_nets() -> None:
    found = shown(radon())
    words = "".join(found.text)
    assert "<i>radon</i>" in words and "county: 2" in words and "tied" in words
    assert found.tags.count("ellipse") == 4 and "i" not in found.tags  # level, y, and twice doubled
    assert "<low>, high" in words and "deterministic" in words
    assert found.tags.count("polygon") == 5  # arrows; the potential has none


def test_nets_that_are_not_complete_or_large() -> None:
    net = bmc.BayesNet("half")
    net.add("x", lambda nobody: bmc.Normal(nobody, 1.0))
    assert "not complete yet: node 'x' has the parent 'nobody'" in "".join(shown(net).text)
    assert "BayesNet" in "".join(shown(bmc.BayesNet()).text)
    chain = bmc.BayesNet("long")
    for k in range(90):
        chain.add(f"x{k}", bmc.Normal(0.0, 1.0))
    found = shown(chain)
    assert "svg" not in found.tags and "... 30 more ..." in found.text


def test_templates() -> None:
    dbn = bmc.DynamicBayesNet("walk")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    words = "".join(shown(dbn).text)
    assert "slice t - 1" in words and "x_prev" in words
    wrong = bmc.DynamicBayesNet("wrong")
    wrong.add("x", lambda nobody: bmc.Normal(nobody, 1.0))
    assert "not complete yet" in "".join(shown(wrong).text)


def test_explanations(capsys: pytest.CaptureFixture[str]) -> None:
    net, evidence = radon(), {"y": np.ones(3)}
    found = bmc.explain(net, evidence, inputs=DATA, engine=bmc.Gibbs())
    words = "".join(shown(found).text)
    assert "engine: Gibbs" in words and "enumerate" in words
    assert "engine: Gibbs" in capsys.readouterr().out
    assert "sampled given its parents" in "".join(
        shown(bmc.explain(net, inputs=DATA, engine=bmc.LikelihoodWeighting(10))).text
    )


def test_posteriors_and_summaries() -> None:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("k", bmc.Bernoulli(0.3), states=("<no>", "yes"))
    posterior = bmc.infer(net, {"x": [1.0, 2.0]})
    words = "".join(shown(posterior).text)
    assert "k[<no>]" in words and "log evidence -4.33788" in words
    assert "x[1]" in "".join(shown(bmc.infer(net).summary()).text)
    kept = bmc.infer(net, engine=bmc.LikelihoodWeighting(5000), keep="summaries", rng=0)
    shown(kept)


def test_beliefs_over_time() -> None:
    dbn = bmc.DynamicBayesNet(plates={"i": 40})
    dbn.table("w", ["w_prev"], [[0.9, 0.1], [0.2, 0.8]], ("<dry>", "wet"), initial=[0.5, 0.5])
    dbn.table("seen", ["w"], [[0.8, 0.2], [0.3, 0.7]])
    found = shown(bmc.filter(dbn, {"seen": [0, 1, 1]}))
    words = "".join(found.text)
    assert "P(<dry>)" in words and found.tags.count("polyline") == 4
    many = bmc.DynamicBayesNet(plates={"i": 40})
    many.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0, 1), plates="i")
    assert "... and 16 more" in shown(bmc.filter(many, {"x": np.zeros((2, 40))})).text


def test_small_parts() -> None:
    assert band(np.array([np.nan, np.nan])) == "" and "<polyline" in band(np.array([1.0]))
    marks = {name: Mark("discrete", hint="a < b") for name in "abcd"}
    edges = [("a", "b"), ("b", "c"), ("a", "c"), ("a", "d")]
    drawn = ElementTree.fromstring(graph(marks, edges, dict.fromkeys(marks, ()), {}))
    names = [text.text for text in drawn.iter("{http://www.w3.org/2000/svg}text")]
    assert names == list("abcd")
    assert table(["", "<x>"], [["a", "<b>"]], "t<").count("&lt;") == 3
