"""Provide the operating points of KSR-III, flown once, and optimisation problems on them."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.schema import read_case
from maxq.design.laws.pd import PdDesign
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.solve import nominal_plants, solve


@cache
def case(*overrides: str, name: str = "ksr3-identical"):
    return read_case(name, overrides)


@cache
def plants(*overrides: str, name: str = "ksr3-identical"):
    """Return the plants of a case, at few operating points unless the overrides set others."""
    return nominal_plants(case(*overrides, name=name))


@cache
def all_nodes(loop: str = "pade"):
    return plants(f"loop={loop}")


@cache
def solution(*overrides: str):
    """Solve the case with identical limits at the eleven operating points of the paper."""
    loaded = case(*overrides)
    return solve(loaded, all_nodes(loaded.case.loop))


def problem(*overrides: str, on=None):
    loaded = case(*overrides)
    return make_problem(loaded.case, all_nodes(loaded.case.loop) if on is None else on)


def pd(p) -> PdVariables:
    """Return the problem's law as PD variables."""
    assert isinstance(p.law, PdVariables)
    return p.law


def designed(s) -> PdDesign:
    """Return the solution's law as a PD design."""
    assert isinstance(s.law, PdDesign)
    return s.law


def some_point(p, seed: int = 0, **_: Any) -> Array:
    """Return a stable design with mild notches and gains near 1 and 0.45."""
    rng = np.random.default_rng(seed)
    y = []
    for name in pd(p).filter.names:
        at = {
            "quadratic[0].zero_hz": np.log(9.5),
            "quadratic[0].zero_zeta": 0.3,
            "quadratic[0].pole_hz": np.log(6.0),
            "quadratic[1].zero_hz": np.log(25.0),
            "quadratic[1].zero_zeta": 0.3,
            "quadratic[1].pole_hz": np.log(20.0),
        }
        y.append(at.get(name, np.log(25.0) if name.endswith("hz") else 0.6))
    n = pd(p).gains.size // 2
    u = np.concatenate([np.full(n, np.log(1.05)), np.full(n, np.log(0.45))])
    return np.concatenate([np.array(y), u]) + 0.01 * rng.standard_normal(p.size)
