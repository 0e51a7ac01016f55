"""The flight in three dimensions: ground, trajectory and vehicle, sent to a recording block by block.

A whole log is one block; a flight under way is many. Positions are in metres in the launch site's frame (x east,
y north, z up). The body is cut into straight pieces that are sheared into a bent line; tanks, fins and skin belong to
their piece. Liquids are meshes whose surface stands across the slosh pendulum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.run.launch_frames import LaunchFrames
from maxq.tools.plots.palette import BLUE, GREY, ORANGE, RED, SKY, rgba
from maxq.tools.replay import mesh
from maxq.tools.replay.bent_body import bent_line, modal_coordinates
from maxq.tools.replay.earth_frame import LaunchSite, Path3D, path_of
from maxq.tools.replay.flight import Channels, Moment
from maxq.tools.replay.sending import changed, every, matrices, times
from maxq.tools.replay.vehicle_meshes import vehicle_meshes
from maxq.tools.replay.vehicle_shape import TankShape, VehicleShape

MOTION_NS, ARROWS_NS, TRAIL_NS = 20_000_000, 40_000_000, 200_000_000
FAR_NS = 100_000_000  # positions of flights that are not seen closely
_BEND_STEP_M, _LEVEL_STEP_M, _ANGLE_STEP_DEG = 2e-4, 1e-3, 2e-3  # smaller changes are not sent
_STEEPEST = math.tan(math.radians(60.0))
_EYE = np.eye(3)
Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Exaggeration:
    """Factors by which bending and slosh angles are drawn larger, and the most that bending is drawn, m."""

    bending: float
    slosh: float
    most_m: float


class Scene:
    """One flight's entities under `root`; of a flight that is not `near` only its place."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        root: str,
        place: LaunchSite,
        shape: VehicleShape | None,
        exaggeration: Exaggeration,
        *,
        trail: tuple[str, str] = (ORANGE, BLUE),
        near: bool = True,
    ) -> None:
        self._rec, self._root, self._place = recording, root, place
        self._shape, self._ex = shape, exaggeration
        self._trail_colours = trail  # under thrust, coasting
        self._near = near
        self._frames: LaunchFrames | None = None
        self.track: list[Array] = []
        """Positions so far."""
        self._last: dict[str, int] = {}
        self._stage = -1
        self._stage_start_ns = 0
        self._trail_end: Array | None = None
        self._static()

    # -- what stands still -------------------------------------------------------------------------------------------
    def _static(self) -> None:
        rec, root = self._rec, f"{self._root}/vehicle"
        rec.log(
            f"{root}/at", rr.Points3D([[0, 0, 0]], radii=rr.Radius.ui_points(3.5), colors=rgba("#ffffff")), static=True
        )
        if not self._near:
            return
        if self._shape is None:
            rec.log(f"{root}/body/marker", rr.Points3D([[0, 0, 0]], radii=rr.Radius.ui_points(6)), static=True)
            size = 10.0
        else:
            size = self._shape.length_m
        axes = 0.45 * size * _EYE
        rec.log(
            f"{root}/body/axes",
            rr.Arrows3D(
                vectors=axes * [1.35, 0.35, 0.35], colors=[rgba(c) for c in (RED, "#22aa55", "#4477ff")],
                radii=0.004 * size, labels=["x", "y", "z"], show_labels=False,
            ),
            static=True,
        )  # fmt: skip
        for name, colour in (("velocity", "#4cd07d"), ("wind", SKY)):
            style = rr.Arrows3D.from_fields(colors=rgba(colour), radii=0.006 * size, show_labels=True)
            rec.log(f"{root}/{name}", style, static=True)

    # -- blocks ------------------------------------------------------------------------------------------------------
    def add(self, channels: Channels) -> None:
        """Send the rows of a block; blocks follow one another in time."""
        if self._frames is None:
            self._frames = self._place.frames(channels.table, MOTION_NS if self._near else FAR_NS)
        path = path_of(channels, self._frames)
        if not len(path.times_ns):
            return
        self.track.append(path.position_m)
        at, root = times(path.times_ns), f"{self._root}/vehicle"
        self._rec.send_columns(root, at, rr.Transform3D.columns(translation=path.position_m))
        if not self._near:
            return
        self._trail(channels, path)
        self._rec.send_columns(f"{root}/body", at, rr.Transform3D.columns(quaternion=path.rotation[:, [1, 2, 3, 0]]))
        self._arrows(channels)
        if self._shape is not None:
            self._vehicle(channels)

    def mark(self, moments: Sequence[Moment], path: Path3D) -> None:
        """Points on the trajectory with names and times."""
        moments = [m for i, m in enumerate(moments) if i + 1 == len(moments) or moments[i + 1].time_s - m.time_s > 1.0]
        if not moments or not len(path.times_ns):
            return
        k = np.clip(np.searchsorted(path.times_ns, [m.time_ns for m in moments]), 0, len(path.times_ns) - 1)
        labels = [f"{m.name.replace('_', ' ')} {m.time_s:.1f} s" for m in moments]
        self._rec.log(
            f"{self._root}/marks",
            rr.Points3D(
                path.position_m[k],
                labels=labels,
                show_labels=True,
                radii=rr.Radius.ui_points(4),
                colors=rgba("#ffffff"),
            ),
            static=True,
        )

    def whole_path(self, path: Path3D, colour: str = GREY) -> None:
        """The whole trajectory as a thin line."""
        k = every(path.times_ns, 1_000_000_000)
        line = rr.LineStrips3D([path.position_m[k]], colors=rgba(colour, 0.7), radii=rr.Radius.ui_points(0.7))
        self._rec.log(f"{self._root}/path", line, static=True)

    def _trail(self, channels: Channels, path: Path3D) -> None:
        k = every(path.times_ns, TRAIL_NS, self._last.get("trail", -1))
        if not len(k):
            return
        self._last["trail"] = int(path.times_ns[k[-1]] // TRAIL_NS)
        points, at = path.position_m[k], path.times_ns[k]
        if self._trail_end is not None:
            points = np.concatenate([self._trail_end[None], points])
        else:
            at = at[1:]
        self._trail_end = points[-1]
        if len(points) < 2:
            return
        burning = _nearest(channels, "thrust_N", at) > 0.0
        colours = np.where(burning[:, None], *(rgba(colour) for colour in self._trail_colours)).astype("u1")
        strips = np.stack([points[:-1], points[1:]], axis=1).astype("f4")
        self._rec.send_columns(
            f"{self._root}/trail",
            times(at),
            rr.LineStrips3D.columns(strips=list(strips), colors=colours, radii=np.full(len(at), -2.2, "f4")),
        )

    def _arrows(self, channels: Channels) -> None:
        """Velocity over the ground in its direction, wind to scale; both say their size."""
        if not all(f"v_N_{a}_mps" in channels for a in ("north", "east", "down")):
            return
        size = self._shape.length_m if self._shape is not None else 10.0
        ns = channels.time_ns("v_N_north_mps")
        k = every(ns, ARROWS_NS, self._last.get("arrows", -1))
        if not len(k):
            return
        self._last["arrows"] = int(ns[k[-1]] // ARROWS_NS)
        places = channels["latitude_deg"][k], channels["longitude_deg"][k]
        v = self._place.from_ned(*places, _triple(channels, "v_N_{}_mps", k))
        speed = np.linalg.norm(v, axis=1)
        grows = np.minimum(speed / 20.0, 1.0) / np.maximum(speed, 1e-9)
        self._send_arrow("velocity", ns[k], v * (0.75 * size * grows)[:, None], speed, "{:.0f} m/s")
        if all(f"wind_N_{a}_mps" in channels for a in ("north", "east", "down")):
            wind = self._place.from_ned(*places, _triple(channels, "wind_N_{}_mps", k))
            blow = np.linalg.norm(wind, axis=1)
            keep = changed(wind, 0.05)
            self._send_arrow(
                "wind",
                ns[k][keep],
                wind[keep] * (size / np.maximum(blow[keep], 60.0))[:, None],
                blow[keep],
                "wind {:.0f} m/s",
            )

    def _send_arrow(self, name: str, ns: IntArray, vectors: Array, sizes: Array, text: str) -> None:
        labels = [text.format(x) if x > 3.0 else "" for x in np.nan_to_num(sizes)]
        columns = rr.Arrows3D.columns(vectors=np.nan_to_num(vectors).astype("f4"), labels=labels)
        self._rec.send_columns(f"{self._root}/vehicle/{name}", times(ns), columns)

    # -- the vehicle -------------------------------------------------------------------------------------------------
    def _vehicle(self, channels: Channels) -> None:
        ns = channels.time_ns("cg_station_m")
        numbers = np.nan_to_num(channels["stage"]).astype(int)
        for number in np.unique(numbers):
            rows = np.flatnonzero(numbers == number)
            begin, end = int(ns[rows[0]]), int(ns[rows[-1]])
            if number != self._stage:
                self._change_stage(int(number), begin)
            cg = channels["cg_station_m"][rows]
            k = changed(cg[:, None], _LEVEL_STEP_M)
            shift = np.stack([cg[k], 0.0 * cg[k], 0.0 * cg[k]], axis=1)
            hull = f"{self._root}/vehicle/body/hull"
            self._rec.send_columns(hull, times(ns[rows][k]), rr.Transform3D.columns(translation=shift))
            self._bend(channels, begin, end)

    def _change_stage(self, number: int, begin_ns: int) -> None:
        assert self._shape is not None
        hull = f"{self._root}/vehicle/body/hull"
        if self._stage >= 0:
            self._set_time(begin_ns)
            self._rec.log(f"{hull}/stage{self._stage + 1}", rr.Clear(recursive=True))
            self._stage_start_ns = begin_ns
        self._stage = number
        static = len(self._shape.stages) == 1
        self._set_time(begin_ns)
        for entity, item in vehicle_meshes(self._shape, number):
            self._rec.log(f"{hull}/stage{number + 1}/{entity}", item, static=static)
        self._rec.reset_time()

    def _set_time(self, ns: int) -> None:
        self._rec.set_time("sim_time", duration=np.timedelta64(ns, "ns"))

    def _bend(self, channels: Channels, begin_ns: int, end_ns: int) -> None:
        """Pieces, engine and liquids of the stage that flies between two times."""
        assert self._shape is not None
        number, stage = self._stage, self._shape.stages[self._stage]
        hull = f"{self._root}/vehicle/body/hull/stage{number + 1}"
        fast = "gimbal_pitch_angle_deg" if "gimbal_pitch_angle_deg" in channels else "cg_station_m"
        ns = channels.time_ns(fast)
        k = every(ns, MOTION_NS, self._last.get(f"bend{number}", -1))
        k = k[(ns[k] >= begin_ns) & (ns[k] <= end_ns)]
        if not len(k):
            return
        self._last[f"bend{number}"] = int(ns[k[-1]] // MOTION_NS)
        at = ns[k]
        clock_s = (at - self._stage_start_ns) / 1e9 * stage.clock_factor
        eta = [modal_coordinates(channels, plane, k) for plane in ("pitch", "yaw")]
        joints = self._shape.joints(number)
        gimbal = stage.engine.gimbal_station_m if stage.engine is not None else joints[-1]
        tanks = [tank for s in self._shape.stages[number:] for tank in s.tanks]
        ends = [x for tank in tanks for x in (tank.bottom_station_m, tank.top_station_m)]
        stations = np.concatenate([joints, [gimbal], ends])
        bent, turn = np.zeros((len(k), len(stations), 2)), np.zeros((len(k), 1, 2))
        if any(len(e) for e in eta):
            bent = bent_line(stage, clock_s, eta[0], eta[1], stations)
            turn = bent_line(stage, clock_s, eta[0], eta[1], np.array([gimbal]), "slope_pm")
        factor = self._ex.bending * np.minimum(
            1.0, self._ex.most_m / np.maximum(np.abs(bent).max(axis=(1, 2)) * self._ex.bending, 1e-9)
        )
        bent, turn = bent * factor[:, None, None], turn * factor[:, None, None]
        self._send_pieces(hull, at, joints, bent[:, : len(joints)])
        if stage.engine is not None:
            self._send_engine(hull, channels, k, at, bent[:, len(joints)], turn[:, 0])
        for i, tank in enumerate(tanks):
            first = len(joints) + 1 + 2 * i
            self._send_liquid(f"{hull}/liquid/{tank.name}", channels, tank, at, clock_s, bent[:, first : first + 2], k)

    def _send_pieces(self, hull: str, at: IntArray, joints: Array, bent: Array) -> None:
        for i, (a, b) in enumerate(itertools.pairwise(joints)):
            start, slope = bent[:, i], (bent[:, i + 1] - bent[:, i]) / (b - a)
            k = changed(bent[:, i : i + 2], _BEND_STEP_M)
            matrix = np.broadcast_to(_EYE.ravel(), (len(k), 9)).copy()  # column by column
            matrix[:, 1:3] = -slope[k]
            move = np.stack([np.full(len(k), -a), start[k, 0], start[k, 1]], axis=1)
            columns = rr.Transform3D.columns(translation=move, mat3x3=matrices(matrix))
            self._rec.send_columns(f"{hull}/piece_{i:02}", times(at[k]), columns)

    def _send_engine(self, hull: str, channels: Channels, k: Rows, at: IntArray, shift: Array, slope: Array) -> None:
        assert self._shape is not None
        engine = self._shape.stages[self._stage].engine
        assert engine is not None
        pitch, yaw = np.zeros(len(at)), np.zeros(len(at))
        if "gimbal_pitch_angle_deg" in channels:
            pitch = np.radians(np.nan_to_num(channels["gimbal_pitch_angle_deg"][k]))
            yaw = np.radians(np.nan_to_num(channels["gimbal_yaw_angle_deg"][k]))
        # the axis is (cos p cos y, -sin y, sin p cos y); bending turns it by its slope with the station
        tilt_y, tilt_z = -np.sin(yaw) - slope[:, 0], np.sin(pitch) * np.cos(yaw) - slope[:, 1]
        axis = np.stack([np.ones(len(at)), tilt_y, tilt_z], axis=1)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        quaternion = np.stack([0 * pitch, -axis[:, 2], axis[:, 1], 1.0 + axis[:, 0]], axis=1)  # turns x into the axis
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        moves = np.stack([np.full(len(at), -engine.gimbal_station_m), shift[:, 0], shift[:, 1]], axis=1)
        sent = changed(np.concatenate([np.degrees(axis[:, 1:]), 50.0 * moves[:, 1:]], axis=1), _ANGLE_STEP_DEG * 5)
        self._rec.send_columns(
            f"{hull}/engine",
            times(at[sent]),
            rr.Transform3D.columns(translation=moves[sent], quaternion=quaternion[sent]),
        )
        if "thrust_N" not in channels:
            return
        thrust = np.nan_to_num(_nearest(channels, "thrust_N", at))
        some = every(at, ARROWS_NS)
        some = some[changed(thrust[some][:, None], 50.0)]
        largest = 0.4 * self._shape.length_m
        length = largest * np.sqrt(np.clip(thrust[some] / max(self._thrust_scale(channels), 1.0), 0.0, 1.5))
        back = engine.exit_station_m - engine.gimbal_station_m
        zero = 0.0 * length
        labels = [f"thrust {x / 1000.0:.3g} kN" if x > 0 else "" for x in thrust[some]]
        self._rec.send_columns(
            f"{hull}/engine/thrust",
            times(at[some]),
            rr.Arrows3D.columns(
                vectors=np.stack([length, zero, zero], 1),
                origins=np.stack([-back - length, zero, zero], 1),
                labels=labels,
            ),
        )

    def _thrust_scale(self, channels: Channels) -> float:
        largest = float(np.nanmax(channels["thrust_N"], initial=0.0))
        self._last["thrust"] = max(self._last.get("thrust", 0), int(largest))
        return float(self._last["thrust"])

    def _send_liquid(
        self, entity: str, channels: Channels, tank: TankShape, at: IntArray, clock_s: Array, shift: Array, k: Rows
    ) -> None:
        height = np.interp(clock_s, *tank.level)
        angles = np.zeros((len(at), 2))
        if f"slosh_{tank.name}_pitch_deg" in channels:
            names = (f"slosh_{tank.name}_yaw_deg", f"slosh_{tank.name}_pitch_deg")
            angles = np.stack([np.nan_to_num(channels[name][k]) for name in names], axis=1)
        tilt = np.clip(np.tan(np.radians(np.clip(angles * self._ex.slosh, -80.0, 80.0))), -_STEEPEST, _STEEPEST)
        some = np.arange(0, len(at), 2)  # surfaces swing slowly
        state = np.concatenate([height[:, None] / 2.0, tilt * tank.radius_m, shift.reshape(len(at), -1) / 5.0], axis=1)
        some = some[changed(state[some], _LEVEL_STEP_M)]
        floor = np.full(len(some), -tank.bottom_station_m)
        # the surface's place between floor and roof decides how far it follows the bent line
        reach = tank.bottom_station_m - tank.top_station_m
        share = np.clip(height[some] / reach, 0.0, 1.0)[:, None]
        low, high = shift[some, 0], shift[some, 0] * (1.0 - share) + shift[some, 1] * share
        vertices = mesh.liquid_vertices(
            floor, floor + height[some], 0.97 * tank.radius_m, tilt[some], np.stack([low, high], axis=1)
        )
        count = vertices.shape[1]
        columns = rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3)).partition([count] * len(some))
        self._rec.send_columns(entity, times(at[some]), columns)


def _triple(channels: Channels, pattern: str, k: Rows) -> Array:
    return np.stack([channels[pattern.format(a)][k] for a in ("north", "east", "down")], axis=1)


def _nearest(channels: Channels, name: str, at: IntArray) -> Array:
    """Values of a channel at times of another rate: the last before."""
    if name not in channels or not len(channels.time_ns(name)):
        return np.zeros(len(at))
    k = np.clip(np.searchsorted(channels.time_ns(name), at, side="right") - 1, 0, None)
    return np.asarray(channels[name][k])
