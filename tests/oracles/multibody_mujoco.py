"""Solve the multibody system without bending with MuJoCo, from an MJCF model.

The core is on a free joint with its frame at C0, the engine on hinges at the gimbal, and bobs on ball joints at their
hinges. Only MuJoCo's mass matrix (`mj_mulM`) and bias force (`qfrc_bias`: Coriolis, centrifugal, gravity) are used; the
accelerations follow from them with the engine's prescribed ones moved to the right-hand side. `mj_fullM` is avoided
because its arguments changed between MuJoCo 3 and 4.

MuJoCo's conventions: the qvel of a free joint is (velocity of the frame origin in world axes, angular velocity in body
axes), that of a ball joint the child's angular velocity relative to its parent, in child axes. Several joints of one
body act from the first (outermost) to the last. The world is I.

Two properties differ from the defined system:
- A bob needs inertia. It has `bob_inertia_ratio` * m L^2, isotropic, about its own centre. The accelerations differ
  from the defined system's in proportion to that ratio; a test measures this.
- Two hinges turn an engine about its own axis d at the rate dpdot * sin(dy), while the definition's angular velocity
  d x ddot has no such component. A third hinge along d removes it (`roll_free_gimbal`). Without it, the rate of change
  of the angular momentum I_t dpdot sin(dy) d also acts on the core.
Limits: no mode pairs; the core without its engine must have a physical inertia tensor, and a bob's m L^2 must stay
above 1e-15 / `bob_inertia_ratio` kg m^2 (MuJoCo's least inertia).
"""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
from oracles.multibody_system import Engine, Floats, Load, State, Vehicle, quaternion_from_rotation, rotation_taking

BOB_INERTIA_RATIO = 1e-12
_X_HAT = np.array([1.0, 0.0, 0.0])


def _point_inertia(mass: float, r: Floats) -> Floats:
    inertia: Floats = mass * (r @ r * np.eye(3) - np.outer(r, r))
    return inertia


def _numbers(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _inertial(mass: float, position: Floats, inertia: Floats) -> str:
    six = np.array([inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]])
    return f'<inertial mass="{mass!r}" pos="{_numbers(position)}" fullinertia="{_numbers(six)}"/>'


def _dry_core(vehicle: Vehicle) -> tuple[float, Floats, Floats]:
    """Return the mass, CG and inertia about that CG of the core without the locked engine."""
    if vehicle.engine is None:
        return vehicle.mass_kg, np.zeros(3), vehicle.inertia_B_kgm2
    engine = vehicle.engine
    r_engine = engine.gimbal_B_m - engine.length_m * _X_HAT
    mass = vehicle.mass_kg - engine.mass_kg
    r_core = -engine.mass_kg / mass * r_engine
    inertia = (
        vehicle.inertia_B_kgm2
        - engine.inertia_kgm2 * np.eye(3)
        - _point_inertia(engine.mass_kg, r_engine)
        - _point_inertia(mass, r_core)
    )
    return mass, r_core, inertia


def _engine_body(engine: Engine, roll_free_gimbal: bool) -> str:
    roll = '<joint name="roll" type="hinge" axis="1 0 0"/>' if roll_free_gimbal else ""
    return (
        f'<body name="engine" pos="{_numbers(engine.gimbal_B_m)}">'
        '<joint name="pitch" type="hinge" axis="0 -1 0"/><joint name="yaw" type="hinge" axis="0 0 -1"/>'
        f"{roll}"
        f"{_inertial(engine.mass_kg, -engine.length_m * _X_HAT, engine.inertia_kgm2 * np.eye(3))}</body>"
    )


def model_text(vehicle: Vehicle, bob_inertia_ratio: float = BOB_INERTIA_RATIO, roll_free_gimbal: bool = True) -> str:
    """Return the MJCF text. Raises ValueError if the vehicle has mode pairs."""
    if vehicle.pairs:
        raise ValueError("the MuJoCo oracle has no bending; use multibody_sympy for a vehicle with mode pairs")
    parts = [_inertial(*_dry_core(vehicle))]
    if vehicle.engine is not None:
        parts.append(_engine_body(vehicle.engine, roll_free_gimbal))
    for k, pendulum in enumerate(vehicle.pendulums):
        inertia = bob_inertia_ratio * pendulum.mass_kg * pendulum.length_m**2 * np.eye(3)
        parts.append(
            f'<body name="bob{k}" pos="{_numbers(pendulum.hinge_B_m)}"><joint type="ball"/>'
            f"{_inertial(pendulum.mass_kg, pendulum.length_m * _X_HAT, inertia)}</body>"
        )
    return (
        '<mujoco><compiler angle="radian" inertiafromgeom="false"/><option gravity="0 0 0"/><worldbody>'
        f'<body name="core"><freejoint/>{"".join(parts)}</body></worldbody></mujoco>'
    )


@lru_cache(maxsize=64)
def _model(text: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(text)


def _set_up(
    vehicle: Vehicle, state: State, gravitation: Floats, ratio: float, roll_free_gimbal: bool
) -> tuple[mujoco.MjModel, mujoco.MjData, list[Floats], list[Floats]]:
    """Return the model and data at the state, and for each pendulum C_B,child and the child's rate relative to B.

    The rate is in child axes.
    """
    model = _model(model_text(vehicle, ratio, roll_free_gimbal))
    model.opt.gravity[:] = gravitation
    data = mujoco.MjData(model)
    q = [state.r_I_m, quaternion_from_rotation(state.C_IB)]
    v = [state.v_I_mps, state.w_BI_B_radps]
    if vehicle.engine is not None:
        q.append(state.deflection_rad)
        v.append(state.deflection_radps)
        if roll_free_gimbal:
            q.append(np.zeros(1))
            v.append(np.array([-state.deflection_radps[0] * np.sin(state.deflection_rad[1])]))
    rotations, rates = [], []
    for u, u_dot in zip(state.u_B, state.udot_B_1ps, strict=True):
        rotation = rotation_taking(_X_HAT, u)
        rate = rotation.T @ np.cross(u, u_dot)
        q.append(quaternion_from_rotation(rotation))
        v.append(rate)
        rotations.append(rotation)
        rates.append(rate)
    data.qpos[:] = np.concatenate(q)
    data.qvel[:] = np.concatenate(v)
    mujoco.mj_forward(model, data)
    return model, data, rotations, rates


def accelerations(
    vehicle: Vehicle,
    state: State,
    load: Load | None = None,
    *,
    bob_inertia_ratio: float = BOB_INERTIA_RATIO,
    roll_free_gimbal: bool = True,
) -> dict[str, Floats]:
    """Return the results of `multibody_sympy.accelerations`, with empty etaddot and xiddot.

    `actuator_torque_Nm` is missing when the gimbal may roll, because MuJoCo's third hinge would carry part of the
    torque.
    """
    load = load or Load()
    model, data, rotations, rates = _set_up(
        vehicle, state, load.gravitation_I_mps2, bob_inertia_ratio, roll_free_gimbal
    )
    n = model.nv
    mass = np.zeros((n, n))
    for column, unit in enumerate(np.eye(n)):
        mujoco.mj_mulM(model, data, mass[column], unit)

    force = np.zeros(n)
    force[:3] = state.C_IB @ load.force_B_N
    force[3:6] = load.moment_B_Nm
    n_gimbal = 0 if vehicle.engine is None else 2 + int(roll_free_gimbal)
    for k, pendulum in enumerate(vehicle.pendulums):
        start = 6 + n_gimbal + 3 * k
        # The damping pair acts at one point, so on the tree it is a pure torque about the hinge.
        stiffness = pendulum.damping_1ps * pendulum.mass_kg * pendulum.length_m**2
        force[start : start + 3] = -stiffness * rates[k]

    acceleration = np.zeros(n)
    given = np.arange(6, 6 + n_gimbal)
    if n_gimbal:
        acceleration[6:8] = state.deflection_radps2
    if n_gimbal == 3:
        yaw = state.deflection_rad[1]
        pitch_rate, yaw_rate = state.deflection_radps
        acceleration[8] = -state.deflection_radps2[0] * np.sin(yaw) - pitch_rate * yaw_rate * np.cos(yaw)
    free = np.setdiff1d(np.arange(n), given)
    right = force - data.qfrc_bias - mass @ acceleration
    scale = 1.0 / np.sqrt(np.diag(mass)[free])
    scaled = mass[np.ix_(free, free)] * np.outer(scale, scale)
    acceleration[free] = scale * np.linalg.solve(scaled, scale * right[free])

    uddot = np.zeros((len(vehicle.pendulums), 3))
    for k, (rotation, rate) in enumerate(zip(rotations, rates, strict=True)):
        start = 6 + n_gimbal + 3 * k
        turning = np.cross(acceleration[start : start + 3], _X_HAT)
        uddot[k] = rotation @ (turning + np.cross(rate, np.cross(rate, _X_HAT)))
    result = {
        "specific_force_B_mps2": state.C_IB.T @ (acceleration[:3] - load.gravitation_I_mps2),
        "wdot_B_radps2": acceleration[3:6],
        "etaddot_mps2": np.zeros(0),
        "xiddot_mps2": np.zeros(0),
        "uddot_B_1ps2": uddot,
    }
    if n_gimbal == 2:
        result["actuator_torque_Nm"] = (mass @ acceleration + data.qfrc_bias)[given]
    return result


def energy(
    vehicle: Vehicle,
    state: State,
    gravitation_I_mps2: Floats | None = None,
    *,
    bob_inertia_ratio: float = BOB_INERTIA_RATIO,
    roll_free_gimbal: bool = True,
) -> dict[str, float]:
    """Return MuJoCo's kinetic and potential energy in J, with the keys of `multibody_sympy.energy`.

    Kinetic energy includes the whole engine; potential energy is zero with all masses in the plane of I's origin.
    """
    gravitation = np.zeros(3) if gravitation_I_mps2 is None else gravitation_I_mps2
    model, data, _, _ = _set_up(vehicle, state, gravitation, bob_inertia_ratio, roll_free_gimbal)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    potential, kinetic = (float(value) for value in data.energy)
    return {"kinetic_J": kinetic, "potential_J": potential, "total_J": kinetic + potential}


def momentum(
    vehicle: Vehicle, state: State, *, bob_inertia_ratio: float = BOB_INERTIA_RATIO, roll_free_gimbal: bool = True
) -> dict[str, Floats]:
    """Return MuJoCo's momenta, with the keys of `multibody_sympy.momentum`."""
    model, data, _, _ = _set_up(vehicle, state, np.zeros(3), bob_inertia_ratio, roll_free_gimbal)
    mujoco.mj_subtreeVel(model, data)
    core = model.body("core").id
    linear = model.body_subtreemass[core] * data.subtree_linvel[core]
    centre, about_centre = data.subtree_com[core], data.subtree_angmom[core]
    return {
        "linear_I_Ns": linear,
        "angular_C0_B_Nms": state.C_IB.T @ (np.cross(centre - state.r_I_m, linear) + about_centre),
        "angular_I_Nms": np.cross(centre, linear) + about_centre,
    }
