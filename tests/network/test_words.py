"""What errors show is right for the net at hand: the names that may be meant, and code that runs."""

import re

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BayesmcError, BroadcastError, PlateError

SHOWN = re.compile(
    r"(net\.add\('\w+', lambda \w+: \w+\.(?:sum|mean)\('\w+'\).*?\)), and read that: (lambda [\w, ]+):"
)


def towns(plates=("city",)):
    net = bmc.BayesNet(plates={"city": 3, "year": 2, "age": 4})
    net.add("x", bmc.Normal(0.0, 1.0), plates=plates)
    return net


@pytest.mark.parametrize("plates", [("city",), ("city", "year"), ("year", "city", "age")])
@pytest.mark.parametrize(
    ("total", "kind"),
    [
        (lambda x: bmc.Normal(x.sum("city"), 1.0), PlateError),
        (lambda x: bmc.Normal(x.mean("city"), 1.0), PlateError),
        (lambda x: bmc.Normal(x.sum() + 0 * x, 1.0), BroadcastError),
        (lambda x: bmc.Normal(np.sum(x) + 0 * x, 1.0), BroadcastError),
    ],
)
def test_sum_over_an_own_plate_shows_lines_that_run(plates, total, kind):
    net = towns(plates)
    net.add("y", total, plates=plates)
    with pytest.raises(kind, match="node .y..*to mix elements") as caught:
        net.sample(1)
    line, signature = SHOWN.search(str(caught.value)).groups()
    net = towns(plates)
    if kind is BroadcastError and len(plates) > 1:
        line = line.replace(line.split("sum('")[1].split("'")[0], plates[0])  # whichever it names
    exec(line, {"net": net})
    mixed = re.search(r"add\('(\w+)'", line).group(1)
    net.add("y", eval(f"{signature}: bmc.Normal(x + {mixed}, 1.0)", {"bmc": bmc}), plates=plates)
    drawn = net.sample(2, rng=0)
    how, plate = re.search(r"\.(sum|mean)\('(\w+)'\)", line).groups()
    assert (how == "mean") == ("mean" in total.__code__.co_names)
    assert drawn[mixed] == pytest.approx(getattr(drawn["x"], how)(axis=1 + plates.index(plate)))


def test_ungathered_parent_is_named():
    net = towns()
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(
        PlateError, match=r"pick elements with x\[index\], reduce with x\.sum\('city'\)"
    ):
        net.sample(1)


def rain():
    net = bmc.BayesNet(plates={"city": ["Ayr", "Bath"]})
    net.add("rain", bmc.Bernoulli(0.3), states=("no", "yes"), plates="city")
    net.input("wind", plates="city")
    net.add("wet", lambda rain, wind: bmc.Normal(wind + (rain == "yes"), 1.0), plates="city")
    return net


SLIPS = {
    "parent": lambda net: (net.add("z", lambda Rain: bmc.Normal(0.0, 1.0)), net.validate()),
    "evidence": lambda net: bmc.infer(net, {"Wet": [1.0, 2.0]}, inputs={"wind": [0.0, 0.0]}),
    "input": lambda net: bmc.infer(net, inputs={"Wind": [0.0, 0.0]}),
    "plate": lambda net: net.add("z", bmc.Normal(0.0, 1.0), plates="City"),
    "plates=": lambda net: net.sample(1, inputs={"wind": [0.0, 0.0]}, plates={"cityy": 2}),
    "state": lambda net: bmc.infer(net, {"rain": ["Yes", "no"]}, inputs={"wind": [0.0, 0.0]}),
    "do": lambda net: net.do(Rain="yes"),
    "record": lambda net: net["wett"],
    "keep": lambda net: bmc.infer(
        net, inputs={"wind": [0.0, 0.0]}, keep=["Rain"], engine=bmc.LikelihoodWeighting(10)
    ),
    "query": lambda net: bmc.infer(net, inputs={"wind": [0.0, 0.0]}).mean("Wet"),
    "argument": lambda net: bmc.infer(net, inputs={"wind": [0.0, 0.0]}).expectation(
        lambda WET: WET
    ),
    "log_prob": lambda net: net.log_prob({"rian": ["no", "no"]}, inputs={"wind": [0.0, 0.0]}),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_slips_of_the_pen_are_met_with_the_name_that_is_there(slip):
    with pytest.raises(BayesmcError, match=r"\(did you mean '(rain|wet|wind|city|yes)'\?\)"):
        SLIPS[slip](rain())
