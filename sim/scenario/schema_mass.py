"""Mass, centre of gravity and inertia of a stage, and what sloshes in its tanks."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from maxq.sim.scenario.bodies import first_impossible, tensors
from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.schema_values import (
    Fraction,
    Matrix,
    NotNegative,
    Positive,
    Section,
    at_most_one,
    needs,
    only_with,
)
from maxq.sim.scenario.tables_csv import Columns, CsvTable

MASS_COLUMNS = Columns(
    "time_s",
    sets=(("mass_kg", "x_cg_m", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),),
    optional=("y_cg_m", "z_cg_m", "Ixy_kgm2", "Ixz_kgm2", "Iyz_kgm2"),
    positive=("mass_kg", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),
    begins_by=0.0,
)
TANK_COLUMNS = Columns(
    "time_s",
    sets=(("slosh_mass_kg", "pendulum_length_m", "hinge_station_m"),),
    optional=("liquid_height_m",),
    positive=("pendulum_length_m",),
    not_negative=("slosh_mass_kg", "liquid_height_m"),
    begins_by=0.0,
)
_SYMMETRY = 1e-9


class Mass(Section):
    """Mass properties of the whole vehicle while this stage flies: a table, or constants."""

    table: Annotated[CsvTable, MASS_COLUMNS] | None = Field(
        default=None,
        description="whole vehicle, liquid included as if frozen, inertia about its CG, over the stage "
        "clock; x_cg_m is the station aft of the nose, y and z are body axes; products of inertia are "
        "integrals, Ixz = int x z dm",
    )
    mass_kg: Positive | None = Field(default=None, description="constant mass (at ignition, when it is expelled), kg")
    x_cg_m: float | None = Field(default=None, description="station of the CG aft of the nose, m")
    y_cg_m: float | None = Field(default=None, description="CG in body y, m (default 0)")
    z_cg_m: float | None = Field(default=None, description="CG in body z, m (default 0)")
    inertia_kgm2: Matrix | None = Field(
        default=None, description="inertia tensor about the CG in B, kg m2: minus the products off the diagonal"
    )
    mass_flow_kgps: NotNegative | None = Field(default=None, description="mass expelled per second, kg/s (default 0)")
    burn_s: NotNegative | None = Field(default=None, description="for how long it is expelled, s")

    @model_validator(mode="after")
    def _check(self) -> Mass:
        if self.table is None:
            self._check_constants()
            return self
        at_most_one(self, ("table", "mass_kg"))
        constants = ("x_cg_m", "y_cg_m", "z_cg_m", "inertia_kgm2", "mass_flow_kgps", "burn_s")
        only_with(self, constants, False, "constant mass_kg")
        table = self.table
        diagonal = np.stack([table[f"I{a}{a}_kgm2"] for a in "xyz"], axis=1)
        products = np.stack([table.get(f"I{a}_kgm2") for a in ("xy", "xz", "yz")], axis=1)
        found = first_impossible(tensors(diagonal, products))
        if found:
            row, problem = found
            raise table.refusal(problem, column="Ixx_kgm2", row=row, value=diagonal[row].tolist(), at=("table",))
        return self

    def _check_constants(self) -> None:
        mass = needs(self, "mass_kg", "mass needs a table or constants", "a number > 0")
        needs(self, "x_cg_m", "mass_kg is given", "a number")
        inertia = np.array(needs(self, "inertia_kgm2", "mass_kg is given", "a 3 x 3 tensor"))
        if np.abs(inertia - inertia.T).max() > _SYMMETRY * np.abs(inertia).max():
            raise refuse("an inertia tensor is symmetric", key=("inertia_kgm2",))
        found = first_impossible(0.5 * (inertia + inertia.T)[None])
        if found:
            raise refuse(found[1], key=("inertia_kgm2",))
        if (self.mass_flow_kgps is None) != (self.burn_s is None):
            missing = "burn_s" if self.burn_s is None else "mass_flow_kgps"
            raise refuse("required key is missing: they go together", "mass_flow_kgps and burn_s", key=(missing,))
        if self.mass_flow_kgps is not None and self.burn_s is not None:
            spent = self.mass_flow_kgps * self.burn_s
            if spent >= mass:
                raise refuse(f"expels {spent:g} kg of {mass:g} kg", f"burn_s * mass_flow_kgps < {mass:g}", ("burn_s",))


class Tank(Section):
    """One tank with a sloshing liquid: a spherical pendulum that hangs at its hinge."""

    name: str = Field(default="", description="name of the tank in logs (default: its number)")
    table: Annotated[CsvTable, TANK_COLUMNS] = Field(
        description="pendulum over the stage clock; its mass is part of the stage's table of mass"
    )
    damping_ratio: Fraction = Field(description="of the pendulum, as a ratio to critical")
    mass_factor: NotNegative = Field(
        default=1.0, description="multiplies the sloshing mass; the vehicle's mass stays as it is"
    )
    length_factor: Positive = Field(
        default=1.0, description="multiplies the pendulum's length: its frequency goes with 1/sqrt"
    )
    radius_m: Positive | None = Field(default=None, description="of the tank, m, for drawings")
    bottom_station_m: float | None = Field(default=None, description="of the tank, m aft of the nose, for drawings")
