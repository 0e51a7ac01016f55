"""A booster: a body attached to the core with its own propellant, which separates while the core flies on."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from maxq.control.kernel.limits import MAX_ENGINES, MAX_PENDULUMS
from maxq.sim.input.errors import refuse
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import LIST_FORM, TABLE_FORM, ChannelPart, Pair, Seconds, Section, optional
from maxq.sim.vehicle.body.section import Mass
from maxq.sim.vehicle.engine.section import EngineSection
from maxq.sim.vehicle.slosh.section import Tank


def form_of(value: Any) -> str:
    return LIST_FORM if isinstance(value, list | tuple) else TABLE_FORM


LISTED, FORM = (Field(min_length=1, max_length=MAX_ENGINES), Tag(LIST_FORM)), Discriminator(form_of)

Engines = Annotated[Annotated[EngineSection, Tag(TABLE_FORM)] | Annotated[tuple[EngineSection, ...], *LISTED], FORM]

BOOSTER_AERO_COLUMNS = Columns("mach", sets=(("CN_alpha_pr", "station_m"), ("CA",)), optional=("CA",), begins_by=0.0)


class BoosterAero(Section):
    """The aerodynamic increments of a booster, based on the reference area of the vehicle."""

    table: Annotated[CsvTable, BOOSTER_AERO_COLUMNS] = Field(
        description="axial force CA on the booster's axis and normal force CN_alpha_pr at station_m on this axis, "
        "added to those of the stage"
    )


class Booster(Section):
    """A body attached to the core. The time of its tables begins at its ignition."""

    name: ChannelPart = Field(description="name in logs; a booster that remains in the next stage keeps its name")
    position_m: Pair = Field(description="y and z of its axis from the body axis, m")
    attachments_m: tuple[float, ...] = Field(
        min_length=1,
        max_length=2,
        description="stations of the core that carry it: one that clamps it, or two that hold its ends; the first "
        "carries its axial load",
    )
    ignition_s: Seconds = optional("ignition on the stage clock, s", 0.0)
    mass: Mass = Field(
        description="mass properties of the booster alone; x_cg_m aft of the vehicle's nose, y and z from the "
        "booster's axis"
    )
    engine: Engines | None = optional(
        "one table, or a list [[...]]; offset_m is from the booster's axis; gimballed engines without a group form "
        "a group with the booster's name"
    )
    tank: tuple[Tank, ...] = optional("tanks with sloshing liquid, on the booster's axis", (), max_length=MAX_PENDULUMS)
    aero: BoosterAero | None = optional("absent: no increments")

    @property
    def own_engines(self) -> tuple[EngineSection, ...]:
        """Return the engines that burn the propellant of this booster, with offsets from its axis."""
        return (self.engine,) if isinstance(self.engine, EngineSection) else self.engine or ()

    @property
    def engines(self) -> tuple[EngineSection, ...]:
        """Return the engines with offsets from the vehicle's axis."""
        return tuple(
            _placed(engine, self.position_m, self.name, k if isinstance(self.engine, tuple) else None)
            for k, engine in enumerate(self.own_engines)
        )

    def _check(self) -> None:
        if self.mass.rate_damping is not None:
            raise refuse("damping by body rates belongs to the stage", "[stage.mass]", ("mass", "rate_damping"))
        if len(set(self.attachments_m)) < len(self.attachments_m):
            raise refuse("both ends are held at one station", "one station, or two", "attachments_m")


@cached_by_identity
def _placed(engine: EngineSection, position_m: Pair, name: str, number: int | None) -> EngineSection:
    """Return an engine with its offset from the body axis, a name and a group.

    `number` is its index if the booster has a list of engines, and None otherwise.
    """
    offset_m = (engine.offset_m[0] + position_m[0], engine.offset_m[1] + position_m[1])
    own = engine.name or (name if number is None else f"{name}_{number + 1}")
    group = engine.group if engine.group or engine.gimbal == "fixed" else name
    return engine.model_copy(update={"offset_m": offset_m, "name": own, "group": group})
