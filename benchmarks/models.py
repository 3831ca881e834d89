"""The models that are timed: a discrete net declared by functions, and a hybrid net of 20 nodes.

The hybrid net is the drivetrain of a wind turbine: where and when it runs, how worn it is, whether
a bearing is failing, and what the sensors say. Its tables stand here so that the hand-written
comparator (``floors/lw_hybrid.py``) uses the very same numbers. ``bmc`` is handed in as the module
that supplies the distributions: nothing here imports bayesmc.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np

ALARM_EVIDENCE = {
    "HRBP": "HIGH",
    "CVP": "NORMAL",
    "EXPCO2": "LOW",
    "PRESS": "HIGH",
    "BP": "LOW",
}
"""Five monitor readings, all leaves: p(evidence) = 0.0853, ESS a fifth of the draws."""

EVIDENCE = {"power": 900.0, "oil": 52.0, "vibration": 2.6, "debris": 6, "warning": 1}
"""Sensor readings of one turbine: three continuous, a count and a flag."""

SITE = np.array([0.5, 0.3, 0.2])  # inland, coastal, offshore
SEASON = np.array([0.25, 0.25, 0.25, 0.25])
AMBIENT = np.array([[1.0, 4.0, 6.0], [10.0, 10.0, 9.0], [20.0, 18.0, 15.0], [11.0, 12.0, 12.0]])
AMBIENT_SD = np.array([5.0, 4.0, 3.0])  # degrees Celsius, as AMBIENT
WIND_SHAPE = np.array([4.0, 5.0, 6.0])
WIND_RATE = np.array([0.6, 0.6, 0.6])  # per m/s
FAULT_FLOOR = np.array([0.05, 0.01])  # by maintained
FAULT_SLOPE = np.array([0.60, 0.30])
SEVERITY_A = np.array([1.2, 3.0])  # by fault
SEVERITY_B = np.array([12.0, 4.0])
MODE = np.array(
    [[[0.80, 0.15, 0.05], [0.92, 0.06, 0.02]], [[0.20, 0.50, 0.30], [0.30, 0.55, 0.15]]]
)
NOISE = np.array([48.0, 45.0, 38.0])  # dB, by mode
COST_SHAPE = np.array([1.5, 2.0, 4.0])  # by mode

HIDDEN_CONTINUOUS = (
    "age", "wear", "ambient", "wind", "load", "severity", "friction", "noise", "life", "cost",
)  # fmt: skip
HIDDEN_DISCRETE = ("site", "season", "maintained", "fault", "mode")


class Record(Protocol):
    """What a parsed BIF gives for one node; ``probs`` has the parents' axes first."""

    name: str
    states: Any
    parents: Any
    probs: np.ndarray


def declare(bmc: Any) -> Any:
    """The turbine as 20 plain functions."""
    net = bmc.BayesNet("turbine")
    _declare_surroundings(bmc, net)
    _declare_condition(bmc, net)
    _declare_sensors(bmc, net)
    _declare_consequences(bmc, net)
    return net


def alarm_functions(bmc: Any, records: Iterable[Record]) -> Any:
    """A discrete net declared by functions that look their row up, as a user would write them."""
    net = bmc.BayesNet("alarm")
    for record in records:
        function = _row(bmc, np.asarray(record.probs))
        net.add(record.name, function, parents=list(record.parents), states=record.states)
    return net


def _row(bmc: Any, table: np.ndarray) -> Any:
    if table.ndim == 1:
        return lambda: bmc.Categorical(table)
    return lambda *codes: bmc.Categorical(table[codes])


def _declare_surroundings(bmc: Any, net: Any) -> None:
    @net.node
    def site():
        return bmc.Categorical(SITE)

    @net.node
    def season():
        return bmc.Categorical(SEASON)

    @net.node
    def ambient(season, site):
        return bmc.Normal(AMBIENT[season, site], AMBIENT_SD[site])

    @net.node
    def wind(site):
        return bmc.Gamma(WIND_SHAPE[site], WIND_RATE[site])

    @net.node
    def load(wind):
        share = np.minimum(wind / 12.0, 1.0)
        return share * share * share


def _declare_condition(bmc: Any, net: Any) -> None:
    @net.node
    def age():
        return bmc.Gamma(2.5, 0.35)

    @net.node
    def wear(age):
        return 1.0 - np.exp(-age / 15.0)

    @net.node
    def maintained():
        return bmc.Bernoulli(0.85)

    @net.node
    def fault(wear, maintained):
        return bmc.Bernoulli(FAULT_FLOOR[maintained] + FAULT_SLOPE[maintained] * wear)

    @net.node
    def severity(fault):
        return bmc.Beta(SEVERITY_A[fault], SEVERITY_B[fault])

    @net.node
    def friction(severity, wear):
        return bmc.Normal(0.2 + 0.3 * wear + 0.9 * severity, 0.08)


def _declare_sensors(bmc: Any, net: Any) -> None:
    @net.node
    def power(load, severity):
        return bmc.Normal(2000.0 * load * (1.0 - 0.3 * severity), 150.0)

    @net.node
    def oil(ambient, load, friction):
        return bmc.Normal(ambient + 25.0 * load + 35.0 * friction, 4.0)

    @net.node
    def vibration(load, severity):
        return bmc.StudentT(5.0, 0.8 + load * (1.5 + 4.0 * severity), 0.5)

    @net.node
    def debris(severity, wear):
        return bmc.Poisson(np.exp(0.5 + wear + 3.0 * severity))

    @net.node
    def warning(friction, load):
        return bmc.Bernoulli(1.0 / (1.0 + np.exp(3.0 - 4.0 * friction - load)))


def _declare_consequences(bmc: Any, net: Any) -> None:
    @net.node
    def mode(fault, maintained):
        return bmc.Categorical(MODE[fault, maintained])

    @net.node
    def noise(mode, load):
        return bmc.Normal(NOISE[mode] + 6.0 * load, 1.5)

    @net.node
    def life(severity):
        return bmc.Exponential(0.1 + 2.0 * severity**2)

    @net.node
    def cost(mode, severity):
        return bmc.Gamma(COST_SHAPE[mode], 1.0 / (1.0 + 5.0 * severity))
