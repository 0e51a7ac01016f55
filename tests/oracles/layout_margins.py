"""Compute the margins of a design by simvehicle or simdesign without design/loop and design/margins.

The vehicle is derived by d'Alembert's principle (`dalembert_plant`) with its engines joined into one on the axis. The
actuator is of second order, and the gyro is that of `pitch_plane`. The loop is sampled with matrix exponentials and
measured on a fine grid (`sampled_pitch_loop`). The design file gives gains and filter, the vehicle file actuator, gyro
and computer. Flight condition and tables at an operating point are the simulator's.

Limits of validity: equal engines parallel to the axis, planar modes, no TVC load, one gyro, `law = "pd"` with quadratic
sections, operating points at rows of the gain table. The joined engine omits the distance of the nozzles from the axis
in jet damping.
"""

from __future__ import annotations

import dataclasses
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from oracles import sampled_pitch_loop
from oracles.dalembert_plant import dalembert_plant
from oracles.hand_model import planar_of
from oracles.pitch_plane import Linear, gyro
from oracles.sampled_pitch_loop import Margins, Quadratic

from maxq import Node
from maxq.design.model.node import nodes_along
from maxq.sim.scenario.loader import load_scenario

SUMMED = ("vacuum_thrust_N", "exit_area_m2", "gimballed_mass_kg", "inertia_about_gimbal_kgm2", "flow_share")


@dataclass(frozen=True)
class Evaluated:
    """An operating point of the product (`node`), its margins and the largest magnitude of a closed-loop pole in z."""

    node: Node
    margins: Margins
    largest_pole: float


def evaluate(folder: Path, design_file: Path, every: int = 1) -> list[Evaluated]:
    """Return the margins at each `every`-th row of every stage's gain table, in pitch and yaw."""
    scenario = load_scenario(folder / "scenario.toml", [f'design="{design_file.resolve().as_posix()}"'])
    design = tomllib.loads(design_file.read_text(encoding="utf-8"))
    vehicle = tomllib.loads((folder / "vehicle" / "vehicle.toml").read_text(encoding="utf-8"))
    period_s, delay_s = vehicle["computer"]["sample_s"], vehicle["computer"]["delay_s"]
    out = []
    for number, stage in enumerate(vehicle["stage"]):
        law = design | design.get("stage", [{}] * (number + 1))[number]
        rows = {row["time_s"]: row for row in law["gains"]["table"][::every]}
        sections = [Quadratic(**section) for section in law["filter"].get("quadratic", [])]
        prewarp_hz = law["filter"].get("prewarp_hz", 1.0)  # without sections it has no effect
        for plane in ("pitch", "yaw"):
            nodes = [node for node in nodes_along(scenario, list(rows), plane) if node.stage == number]
            for node in nodes:
                row = rows[node.time_s]
                plant = sampled_pitch_loop.sampled_plant(_plant(node, stage), period_s, delay_s)
                law_here = sampled_pitch_loop.controller(row["k_p"], row["k_d_s"], sections, period_s, prewarp_hz)
                grid = sampled_pitch_loop.frequency_grid(plant, period_s)
                grid = np.unique(np.concatenate([grid, np.geomspace(1e-3, 0.5 / period_s, 6000)]))
                loop = sampled_pitch_loop.response(plant, grid, period_s)
                loop = loop * sampled_pitch_loop.response(law_here, grid, period_s)
                poles = sampled_pitch_loop.closed_loop_poles(plant, law_here)
                out.append(Evaluated(node, sampled_pitch_loop.margins(loop), float(np.abs(poles).max())))
    return out


def _plant(node: Node, stage: dict[str, Any]) -> Linear:
    """Return the plant from gimbal command (rad) to the integral of the gyro's output (rad).

    States: vehicle, actuator, gyro.
    """
    planar = planar_of(node)
    total = {name: sum(getattr(engine, name) for engine in planar.engines) for name in SUMMED}
    joined = dataclasses.replace(planar, engines=(dataclasses.replace(planar.engine, **total),))
    body = dalembert_plant(joined, node.condition)
    given = stage["actuator"][0] if isinstance(stage["actuator"], list) else stage["actuator"]
    assert given["model"] == "second-order"
    w, zeta = 2.0 * np.pi * given["omega_hz"][0], given["zeta"][0]
    sensed = gyro(stage["gyro"]["omega_hz"], stage["gyro"]["zeta"])
    n, end = len(body.a), len(body.a) + 2
    a, b = np.zeros((end + len(sensed.a), end + len(sensed.a))), np.zeros(end + len(sensed.a))
    a[:n, :n] = body.a
    a[:n, n] = body.b[:, 0] - w * w * body.b[:, 1]  # the engine's angle, and its acceleration w^2 (u - x) - 2 z w x'
    a[:n, n + 1] = -2.0 * zeta * w * body.b[:, 1]
    a[n, n + 1], a[n + 1, n : n + 2] = 1.0, (-w * w, -2.0 * zeta * w)
    b[:n], b[n + 1] = w * w * body.b[:, 1], w * w
    a[end:, :n] = np.outer(sensed.b, _angle_at_gyro(body.c[1], joined.modes.omega_radps.size))
    a[end:, end:] = sensed.a
    return Linear(a, b, np.concatenate([np.zeros(end), sensed.c]))


def _angle_at_gyro(rate: np.ndarray[Any, Any], modes: int) -> np.ndarray[Any, Any]:
    """Return the integral of the local rate of a body with states w, q, theta, eta, ...: terms in theta and eta."""
    out = np.zeros_like(rate)
    out[2], out[3 : 3 + modes] = rate[1], rate[3 + modes : 3 + 2 * modes]
    return out
