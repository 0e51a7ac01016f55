"""Describe a gimballed engine at one instant, in one plane, and its optional mount compliance."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GimballedEngine:
    vacuum_thrust_N: float
    exit_area_m2: float
    gimbal_station_m: float
    exit_station_m: float
    gimballed_mass_kg: float
    cg_from_gimbal_m: float
    inertia_about_gimbal_kgm2: float
    follower: bool  # thrust turns with the bent gimbal
    gain: float = 1.0  # angle per command of the law, by allocation; 0 for an engine fixed in this plane
    drive: int = 0  # which of the unlike actuators moves it
    group: int = 0  # of engines that go together
    numbers: tuple[int, ...] = (0,)  # of the stage's engines that it stands for: alike ones of a group are one here
    tvc_load: TvcLoad | None = None  # None: it follows its actuator
    gimbal: int = 0  # which of the gimbals' stations
    beside_m: float = 0.0  # gimbal from the body axis across the plane's axis of turning: z in pitch, y in yaw
    from_cg_m: float = 0.0  # and from the core's CG
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)  # of thrust at rest, B
    unloaded: tuple[float, float, float] | None = None  # the same without axial load, where that bends its mount
    plane: str = "pitch"
    across: float = 0.0  # 1 where it is gimballed in the other plane as well
    flow_share: float = 1.0  # of the mass flow
    exit_square_m2: float = 0.0  # mean square of the nozzle exits' distance across from the CG

    def _in_plane(self, axis: tuple[float, float, float]) -> tuple[float, float]:
        return axis[0], axis[2 if self.plane == "pitch" else 1]

    @property
    def rest(self) -> tuple[float, float]:
        """Return the thrust axis at rest: forward and lateral components."""
        return self._in_plane(self.axis)

    @property
    def mounted(self) -> tuple[float, float]:
        """Return the thrust axis at rest without axial load."""
        return self._in_plane(self.unloaded or self.axis)

    @property
    def slope(self) -> tuple[float, float]:
        """Return the change of the thrust axis per radian."""
        x, y, z = self.axis
        level = np.sqrt(1.0 - y * y)
        return (-z, x) if self.plane == "pitch" else (-y * x / level, level)

    @property
    def other_slope(self) -> tuple[float, float]:
        """Return the change in this plane per radian of the other plane's angle."""
        x, y, z = self.axis
        level = np.sqrt(1.0 - y * y)
        return (
            (self.across * x * y / level, self.across * z * y / level)
            if self.plane == "pitch"
            else (-self.across * z, 0.0)
        )

    @property
    def levers(self) -> tuple[float, float]:
        """Return the squared changes of the thrust axis in space, per radian of each angle."""
        y = self.axis[1]
        return (1.0 - y * y, 1.0) if self.plane == "pitch" else (1.0, 1.0 - y * y)

    @property
    def twist(self) -> float:
        """Return the mixed second derivative of the forward component by both angles."""
        _, y, z = self.axis
        mixed: float = self.across * y * z / np.sqrt(1.0 - y * y)
        return -mixed if self.plane == "pitch" else mixed

    @property
    def sags(self) -> bool:
        """Return True for a canted engine on a TVC load, which sags."""
        return self.tvc_load is not None and (self.axis[1] != 0.0 or self.axis[2] != 0.0)

    def hanging(self, load_mps2: float) -> GimballedEngine:
        """Return the engine at its position under the axial load `load_mps2`: a canted engine sags.

        k (p - p0) = -S a sin p cos y and k (y - y0) = -S a cos p sin y (docs/model.md, 14).
        """
        if not self.sags or self.tvc_load is None:
            return self
        x, y, z = self.axis
        pull = load_mps2 * self.gimballed_mass_kg * self.cg_from_gimbal_m / self.tvc_load.stiffness_Nmprad
        pitch, yaw = start = np.arctan2(z, x), -np.arcsin(y)
        pitch_pull, yaw_pull = (pull, self.across * pull) if self.plane == "pitch" else (self.across * pull, pull)
        for _ in range(20):  # Newton's steps in turn; the pull straightens, so that both slopes are above 1
            level, stiff = np.sin(pitch) * np.cos(yaw), np.cos(pitch) * np.cos(yaw)
            pitch = pitch - (pitch - start[0] + pitch_pull * level) / (1.0 + pitch_pull * stiff)
            level, stiff = np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw)
            yaw = yaw - (yaw - start[1] + yaw_pull * level) / (1.0 + yaw_pull * stiff)
        axis = np.cos(pitch) * np.cos(yaw), -np.sin(yaw), np.sin(pitch) * np.cos(yaw)
        return dataclasses.replace(self, axis=axis, unloaded=self.axis)

    def thrust_N(self, pressure_Pa: float) -> float:
        thrust: float = np.maximum(self.vacuum_thrust_N - pressure_Pa * self.exit_area_m2, 0.0)
        return thrust


@dataclass(frozen=True)
class TvcLoad:
    """The compliance between engine and actuators, about the gimbal; friction and stops are nonlinear and omitted."""

    stiffness_Nmprad: float
    damping_Nmsprad: float
