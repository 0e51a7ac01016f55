"""The schema of the bending modes of a stage in the vehicle file."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.input.errors import Path, refuse
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import Fraction, Positive, Section, optional
from maxq.sim.vehicle.modes.tables import (
    MODE_COLUMNS,
    OVER_MASS,
    SPATIAL_COLUMNS,
    ModeTable,
    SpatialModeTable,
    mode_table,
    spatial_mode_table,
)


def _ones(data: dict[str, Any]) -> tuple[float, ...]:
    """Return the default of a factor per mode: 1 for each damping ratio."""
    return (1.0,) * len(data.get("damping_ratio", ()))


class BendingSection(Section):
    """The free-free bending modes, with the engine locked and without slosh masses."""

    pitch: Annotated[CsvTable, MODE_COLUMNS] | None = optional(
        "modes of the pitch plane, a row for each time (or total mass), mode and station (default: none)"
    )
    yaw: Annotated[CsvTable, MODE_COLUMNS] | None = optional(
        "modes of the yaw plane; may be the same file (default: none)"
    )
    damping_ratio: tuple[Fraction, ...] = Field(
        max_length=MAX_MODES, description="damping ratio of each mode in both planes"
    )
    frequency_factor: tuple[Positive, ...] = Field(
        default_factory=_ones, description="factor on the frequency of each mode (default: 1)"
    )
    gyro_slope_factor: tuple[float, ...] = Field(
        default_factory=_ones, description="factor on the slope of each mode at the gyro (default: 1)"
    )
    gimbal_shape_factor: tuple[float, ...] = Field(
        default_factory=_ones, description="factor on displacement and slope of each mode at the gimbal (default: 1)"
    )

    def _check(self) -> None:
        if not any(OVER_MASS in table for table in (self.pitch, self.yaw) if table is not None):
            self.check_counts()

    def check_counts(self, at: Path = ()) -> None:
        """Reject lists whose length is not the number of modes; `at` is the path of the section."""
        _refuse_other_counts(self, max((t.modes for t in (self.pitch_modes, self.yaw_modes) if t), default=0), at)

    @property
    def pitch_modes(self) -> ModeTable | None:
        """Return the modes of the pitch plane as arrays, or None."""
        return None if self.pitch is None else mode_table(self.pitch, ("pitch",))

    @property
    def yaw_modes(self) -> ModeTable | None:
        """Return the modes of the yaw plane as arrays, or None."""
        return None if self.yaw is None else mode_table(self.yaw, ("yaw",))


class SpatialModesSection(Section):
    """The coupled three-dimensional free-free modes, in addition to planar modes; engine locked, no slosh masses."""

    table: Annotated[CsvTable, SPATIAL_COLUMNS] = Field(
        description="a row for each time (or total mass), mode and station: displacement phi along and rotation theta "
        "about x, y, z; mass_kg and roll_inertia_kgm2 lumped at the stations; or a NASTRAN file (op2, f06)"
    )
    damping_ratio: tuple[Fraction, ...] = Field(max_length=MAX_MODES, description="damping ratio of each mode")
    frequency_factor: tuple[Positive, ...] = Field(
        default_factory=_ones, description="factor on the frequency of each mode (default: 1)"
    )
    gyro_slope_factor: tuple[float, ...] = Field(
        default_factory=_ones, description="factor on the rotation of each mode at the gyro (default: 1)"
    )
    gimbal_shape_factor: tuple[float, ...] = Field(
        default_factory=_ones, description="factor on displacement and rotation of each mode at the gimbal (default: 1)"
    )

    def _check(self) -> None:
        if OVER_MASS not in self.table:
            self.check_counts()

    def check_counts(self, at: Path = ()) -> None:
        """Reject lists whose length is not the number of modes; `at` is the path of the section."""
        _refuse_other_counts(self, self.modes.modes, at)

    @property
    def modes(self) -> SpatialModeTable:
        """Return the modes as arrays."""
        return spatial_mode_table(self.table, ("table",))


def _refuse_other_counts(modes: BendingSection | SpatialModesSection, count: int, at: Path) -> None:
    for key in ("damping_ratio", "frequency_factor", "gyro_slope_factor", "gimbal_shape_factor"):
        given = len(getattr(modes, key))
        if given != count:
            raise refuse(f"has {given} numbers for {count} modes", f"a list of {count} numbers", (*at, key))
