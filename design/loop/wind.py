"""The wind response of a loop's plant: measurements, load, drift and moments per unit of command and of wind."""

from __future__ import annotations

import math

import numpy as np

from maxq.design.laws.law import DRIFTS
from maxq.design.laws.wind import HIGHEST_HZ, Spectrum, WindResponse
from maxq.design.loop.fixed_path import FixedPath
from maxq.design.loop.rational import average
from maxq.design.model.held import WIND, moment_name
from maxq.design.model.instruments import ACCELERATION, lag, per_command
from maxq.design.model.state_space import ComplexArray, Resolvent, channels


def wind_response(path: FixedPath, spectrum: Spectrum, stations_m: tuple[float, ...] = ()) -> WindResponse:
    """Return the wind response of the plant of a path, for the path's measurements and the moments at `stations_m`.

    Spatial modes couple the planes; the other plane is held, as in `Node.plant`. Raises ValueError for a spectrum whose
    band reaches half the sample rate.
    """
    node, timing = path.node, path.node.instruments
    if spectrum.band_hz[1] > max(HIGHEST_HZ, 0.499 / max(timing.sample_s, 1e-9)):
        raise ValueError(
            f"wind.band_hz: allowed are frequencies below half the sample rate, {0.5 / timing.sample_s:g} Hz"
        )
    x = spectrum.frequencies()
    f = np.exp(x)
    s, speed = 2j * np.pi * f, node.condition.airspeed_mps
    ideal = bool(node.actuator.ideal)
    plant = node.plant_in_wind()
    moved = tuple(name for name in plant.inputs if name != WIND and (not ideal or name.startswith("delta_rad")))
    sensed = ("local_rate_radps", *(name for name, _, _ in path.sensors))
    plant = channels(plant, (*sensed, "w_mps", "theta_rad", *map(moment_name, stations_m)), (*moved, WIND))
    way = Resolvent(plant.a, plant.b, plant.c)(s) + plant.d
    held = average(s, timing.sample_s) * np.exp(-timing.delay_s * s)

    def commanded(row: int) -> ComplexArray:
        return np.asarray(held * per_command(s, way[:, row, :-1], moved, node.actuators))

    lags = [(timing.gyro, 0), *((record, late) for _, record, late in path.sensors)]
    means = {}
    for row, (name, (record, late)) in enumerate(zip(("rate_radps", *sensed[1:]), lags, strict=True)):
        out = way[:, row, -1] * average(s, timing.sample_s) * np.exp(-s * late * timing.sample_s)
        means[name] = out if record.ideal else out * lag(s, record.omega_radps, record.zeta)
    summed = path.integrator(f)
    if ACCELERATION in means:
        across = means[ACCELERATION] - node.axial_load_mps2 * summed * means["rate_radps"]
        means |= {name: across * summed ** (1 + k) for k, name in enumerate(DRIFTS)}
    measured = [
        means[name] if name in means else means["rate_radps"] * path.ratio(name, f) for name in path.measurements
    ]
    w, theta = len(sensed), len(sensed) + 1
    load = math.degrees(node.condition.dynamic_pressure_Pa / speed)
    cuts = range(theta + 1, theta + 1 + len(stations_m))
    return WindResponse(
        x=x,
        stations_m=stations_m,
        weights=spectrum.weights(speed),
        paths=np.stack([path.response(f) * path.ratio(name, f) for name in path.measurements], axis=1),
        measured=np.stack(measured, axis=1),
        by_command=np.stack([load * commanded(w), commanded(w) - speed * commanded(theta), *map(commanded, cuts)]),
        by_wind=np.stack(
            [load * (way[:, w, -1] - 1.0), way[:, w, -1] - speed * way[:, theta, -1], *(way[:, k, -1] for k in cuts)]
        ),
    )
