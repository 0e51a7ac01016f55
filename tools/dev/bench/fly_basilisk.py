"""The Basilisk worker: a rigid hub with three sloshing masses and two hinged panels, RK4, 60 s.

This is the closest approximation of a launch vehicle with Basilisk's state effectors. It has thrust and gravity with
J2, but no air, no flight computer and no recorder.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

from Basilisk.simulation import (  # type: ignore[import-not-found]  # in .venv-bench only
    extForceTorque,
    fuelTank,
    hingedRigidBodyStateEffector,
    linearSpringMassDamper,
    spacecraft,
    svIntegrators,
)
from Basilisk.utilities import SimulationBaseClass, macros, simIncludeGravBody  # type: ignore[import-not-found]  # in .venv-bench only

from maxq.tools.dev.bench.serve import State, serve

STEP_S = float(sys.argv[1]) if len(sys.argv) > 1 else 0.001
FLOWN_S = 60.0


def _slosh(vehicle: Any) -> list[Any]:
    """Add a tank with a sloshing mass along each axis to the vehicle. Return its parts."""
    tank, model = fuelTank.FuelTank(), fuelTank.FuelTankModelConstantVolume()
    model.propMassInit, model.radiusTankInit = 400.0, 0.5
    model.r_TcT_TInit = [[0.0], [0.0], [0.0]]
    tank.setTankModel(model)
    tank.setR_TB_B([[0.0], [0.0], [0.1]])
    tank.setNameOfMassState("tank")
    tank.setUpdateOnly(True)
    masses = []
    for axis, mass_kg in enumerate((150.0, 140.0, 130.0)):
        bob = linearSpringMassDamper.LinearSpringMassDamper()
        bob.k, bob.c, bob.massInit = 500.0, 15.0, mass_kg
        bob.r_PB_B = [[0.1 * axis], [0.0], [-0.1]]
        bob.pHat_B = [[float(axis == j)] for j in range(3)]
        bob.rhoInit, bob.rhoDotInit = 0.02, 0.0
        tank.pushFuelSloshParticle(bob)
        masses.append(bob)
    vehicle.addStateEffector(tank)
    for bob in masses:
        vehicle.addStateEffector(bob)
    return [tank, model, *masses]


def _panels(vehicle: Any) -> list[Any]:
    """Add two panels on damped hinges to the vehicle, and return them."""
    panels = []
    for side in (1.0, -1.0):
        panel = hingedRigidBodyStateEffector.HingedRigidBodyStateEffector()
        panel.mass, panel.d, panel.k, panel.c = 100.0, 1.5, 1e4, 10.0
        panel.IPntS_S = [[100.0, 0.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 50.0]]
        panel.r_HB_B = [[0.5 * side], [0.0], [1.0]]
        panel.dcm_HB = [[-side, 0.0, 0.0], [0.0, -side, 0.0], [0.0, 0.0, 1.0]]
        panel.thetaInit, panel.thetaDotInit = 0.01, 0.0
        panel.nameOfThetaState, panel.nameOfThetaDotState = f"theta{side:+.0f}", f"rate{side:+.0f}"
        vehicle.addStateEffector(panel)
        panels.append(panel)
    return panels


def prepare() -> Callable[[], tuple[int, State]]:
    simulation = SimulationBaseClass.SimBaseClass()
    simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", macros.sec2nano(STEP_S)))
    vehicle = spacecraft.Spacecraft()
    vehicle.ModelTag = "vehicle"
    simulation.AddModelToTask("task", vehicle)
    integrator = svIntegrators.svIntegratorRK4(vehicle)
    vehicle.setIntegrator(integrator)
    alive = [vehicle, integrator, *_slosh(vehicle), *_panels(vehicle)]  # C++ keeps plain pointers to these objects
    thrust = extForceTorque.ExtForceTorque()
    thrust.extForce_B = [[0.0], [0.0], [20000.0]]
    thrust.extTorquePntB_B = [[0.0], [1.0], [0.0]]
    vehicle.addDynamicEffector(thrust)
    simulation.AddModelToTask("task", thrust)
    hub = vehicle.hub
    hub.mHub, hub.r_BcB_B = 1500.0, [[0.0], [0.0], [0.0]]
    hub.IHubPntBc_B = [[900.0, 0.0, 0.0], [0.0, 800.0, 0.0], [0.0, 0.0, 600.0]]
    hub.sigma_BNInit, hub.omega_BN_BInit = [[0.0], [0.0], [0.0]], [[0.01], [-0.01], [0.01]]
    hub.r_CN_NInit, hub.v_CN_NInit = [6700e3, 0.0, 0.0], [0.0, 7500.0, 0.0]
    gravity = simIncludeGravBody.gravBodyFactory()
    gravity.createEarth().isCentralBody = True
    gravity.addBodiesTo(vehicle)
    alive += [thrust, gravity]
    simulation.InitializeSimulation()
    simulation.ConfigureStopTime(macros.sec2nano(FLOWN_S))

    def fly() -> tuple[int, State]:
        simulation.ExecuteSimulation()
        assert alive
        end = vehicle.scStateOutMsg.read()
        square = sum(s * s for s in end.sigma_BN)
        quaternion = [(1.0 - square) / (1.0 + square), *(2.0 * s / (1.0 + square) for s in end.sigma_BN)]
        return round(FLOWN_S / STEP_S), [*end.r_BN_N, *quaternion]

    return fly


def main() -> None:
    serve({"program": "Basilisk", "version": version("bsk"), "flown_s": FLOWN_S}, prepare)


if __name__ == "__main__":
    main()
