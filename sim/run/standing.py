"""The start of a flight on the clamp of its tail: the static deflection of the vehicle under the loads of the pad."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import from_python, kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.sim.packing.flight import Packed
from maxq.sim.run.evaluate import Instant, evaluate_at
from maxq.sim.vehicle import schedule as columns_of
from maxq.sim.vehicle import state as states
from maxq.sim.vehicle.modes.masses import solved
from maxq.sim.vehicle.state import Q_BI, R_I, V_I, W_BI_B

_STEP_M = 1e-4  # of a modal coordinate in a difference
_ITERATIONS = 4


def stand_still(packed: Packed) -> None:
    """Bend the modes of a clamped vehicle to their static deflection, and let its bobs hang at rest.

    The first gimbal's section keeps its place and slope, so that the body axes lean. A vehicle that is bent already, or
    that no load bends, keeps its state. Engines on a TVC load start at their centre.
    """
    sizes, y = packed.parameters[0].vehicle.sizes, packed.state
    i, j, n, m = int(states.eta_index(sizes)), int(states.xi_index(sizes)), int(sizes.pitch_modes), int(sizes.yaw_modes)
    s, k = int(states.spatial_index(sizes)), int(sizes.spatial_modes)
    coordinates = [*range(i, i + n), *range(j, j + m), *range(s, s + k)]
    speeds = [*range(i + n, i + 2 * n), *range(j + m, j + 2 * m), *range(s + k, s + 2 * k)]
    if not coordinates or y[coordinates].any():
        return
    start = y.copy()

    def accelerations(eta: Array) -> Array:
        return _at_rest(packed, start, coordinates, eta).rate[speeds].copy()

    eta = np.zeros(len(coordinates))
    if not accelerations(eta).any():
        y[:] = start
        return
    units = _STEP_M * np.eye(len(coordinates))
    stiffness = np.stack([accelerations(-unit) - accelerations(unit) for unit in units], axis=1) / (2.0 * _STEP_M)
    for _ in range(_ITERATIONS):
        eta = eta + solved(stiffness, accelerations(eta)[:, None])[0][:, 0]
    _at_rest(packed, start, coordinates, eta)


def _at_rest(packed: Packed, start: Array, coordinates: list[int], eta: Array) -> Instant:
    """Set the state to that with these modal coordinates at rest, with the tail of `start`, and evaluate it."""
    p, y, begin_s = packed.parameters[0], packed.state, 1e-9 * float(packed.memory["clock"]["now_ns"][0])
    y[:] = start
    y[coordinates] = eta
    aux = evaluate_at(packed, y, begin_s).aux
    since_s = float(p.timeline.burn_rate) * (begin_s - 1e-9 * float(p.timeline.stage_start_ns))
    columns, sizes, bend = table_in(packed.pool, p.vehicle.schedule)(since_s), p.vehicle.sizes, aux.gimbal_bending
    cg = columns[columns_of.CORE_CG :]
    straight = (float(cg[0]) - float(p.vehicle.engine.gimbal_station_m[0]), -float(cg[1]), -float(cg[2]))
    along, twist, n = 0.0, 0.0, int(sizes.spatial_modes)
    for mode in range(n):
        first = int(columns_of.place_column(sizes, columns_of.gimbal_place(sizes, 0), 0)) + mode
        along += float(columns[first] * eta[len(eta) - n + mode])
        twist += float(columns[first + 3 * n] * eta[len(eta) - n + mode])
    moved = (along, float(bend.moved_y_m), float(bend.moved_z_m))
    turned, spin = (twist, float(bend.slope_y_rad), float(bend.slope_z_rad)), float(p.environment.earth.rate_radps)
    g = aux.air.gravitation_I_mps2
    gravity = (float(g[0]), float(g[1]), float(g[2]))
    at = tuple(start[Q_BI : Q_BI + 4].tolist()), tuple(start[R_I : R_I + 3].tolist())
    q, place, velocity, rate, down = _leaning(*at, straight, moved, turned, spin, gravity)
    y[Q_BI : Q_BI + 4], y[W_BI_B : W_BI_B + 3] = q, rate
    y[R_I : R_I + 3] += place
    y[V_I : V_I + 3] += velocity
    for tank in range(int(sizes.pendulums) if any(down) else 0):
        first = int(states.pendulum_index(sizes, tank))
        y[first : first + 3] = down
        y[first + 3 : first + 6] = np.cross(rate, down)
    return evaluate_at(packed, y, begin_s)


@kernel
def lean(
    q: vec.Quaternion,
    r: vec.Vector,
    straight: vec.Vector,
    moved: vec.Vector,
    turned: vec.Vector,
    earth_radps: float,
    gravity: vec.Vector,
) -> tuple[vec.Quaternion, vec.Vector, vec.Vector, vec.Vector, vec.Vector]:
    """Return the attitude with which a bent tail keeps its place and slope, and the motion of the body with the Earth.

    `q`, `r`: attitude and place of the straight body. `straight`: tail from its CG; `moved`, `turned`: displacement and
    rotation of the tail by bending, B. Returns the changes of position and velocity in I, the angular rate in B, and
    the direction of gravity on the turning Earth in B, 0 without gravity.
    """
    leaning = vec.quaternion_product(q, vec.quaternion_of(vec.scaled(-1.0, turned)))
    before = vec.rotation_from_quaternion(q[0], q[1], q[2], q[3])
    after = vec.rotation_from_quaternion(leaning[0], leaning[1], leaning[2], leaning[3])
    shift = vec.add(vec.rotate(before, straight), vec.scaled(-1.0, vec.rotate(after, vec.add(straight, moved))))
    earth = (0.0, 0.0, earth_radps)
    weight = vec.add(gravity, vec.scaled(-1.0, vec.cross(earth, vec.cross(earth, r))))
    down = vec.scaled(1.0 / max(vec.norm(weight), 1e-300), weight)
    return leaning, shift, vec.cross(earth, shift), vec.rotate_back(after, earth), vec.rotate_back(after, down)


_leaning = from_python(lean)
