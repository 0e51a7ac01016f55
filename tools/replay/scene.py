"""The flight in three dimensions: ground, trajectory and vehicle, sent to a recording block by block.

A whole log is one block; a running flight has many. Positions are in metres in the frame of the launch site (x east, y
north, z up). The body is cut into straight pieces that are sheared to follow the bent line. Skin, tanks and fins belong
to a piece. Liquids are meshes whose surface is perpendicular to the slosh pendulum.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.log.messages import FramePath
from maxq.sim.run.launch_frames import LaunchFrames
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.plots.palette import BLUE, ORANGE, RED, SKY, WHITE, rgba
from maxq.tools.replay.decimate import KeptRows, changed, every, last_before
from maxq.tools.replay.flight import Channels, Moment, ShownLaunchSite, path_of
from maxq.tools.replay.meshes import booster_mesh, liquid_vertices, load_colours, mesh3d, plate, vehicle_meshes
from maxq.tools.replay.stream import matrices, set_time, times
from maxq.tools.replay.vehicle_shape import (
    PLANES,
    SECTION,
    EngineShape,
    Exaggeration,
    LoadStations,
    TankShape,
    VehicleShape,
    bent_line,
    modal_coordinates,
)

MOTION_NS, ARROWS_NS, TRAIL_NS = 20_000_000, 40_000_000, 200_000_000
FAR_NS = 100_000_000
"""The period of the positions of flights without a vehicle."""
_BEND_STEP_M, _LEVEL_STEP_M, _ANGLE_STEP_DEG = 2e-4, 1e-3, 2e-3  # smaller changes are not sent
_LOAD_STEP = 0.02  # share of the limit
_STEEPEST = math.tan(math.radians(60.0))
_FALL_NS, _DRIFT_mps = 6_000_000_000, 2.0  # motion of a separated booster, as it is shown
_MARKS_APART = 0.04  # share of the extent of a trajectory, so that names on it are legible
_NO_SHAPE_M = 10.0  # assumed length of an unknown vehicle
_GRID, _PAD, _BLOCK, _COMPASS = [74, 88, 106, 150], [96, 112, 132, 255], [110, 100, 88, 255], [150, 160, 175, 255]
_NED = ("north", "east", "down")


class Scene:
    """The entities of a flight under `root`. A flight that is not `near` has only its position.

    `trail` contains the colours of the trajectory under thrust and while coasting.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        root: str,
        place: ShownLaunchSite,
        shape: VehicleShape | None,
        exaggeration: Exaggeration,
        *,
        trail: tuple[str, str] = (ORANGE, BLUE),
        near: bool = True,
    ) -> None:
        self._rec, self._root, self._place = recording, root, place
        self._shape, self._ex, self._near = shape, exaggeration, near
        self._size = shape.length_m if shape is not None else _NO_SHAPE_M
        self._trail_colours = [rgba(colour) for colour in trail]  # under thrust, coasting
        self._frames: LaunchFrames | None = None
        self.track: list[Array] = []
        """The positions sent so far, (n, 3) for each block."""
        self._last: dict[str, int] = {}  # period of the last row sent, by kind of data
        self._largest_thrust_N, self._largest_moment_Nm = 1.0, 0.0
        self._loaded = False
        self._stage = -1
        self._stage_start_ns = 0
        self._trail_end: Array | None = None
        self._log("vehicle/at", rr.Points3D([[0, 0, 0]], radii=rr.Radius.ui_points(3.5), colors=rgba(WHITE)))
        if near:
            self._static()

    def _log(self, entity: str, item: rr.AsComponents) -> None:
        """Log static data."""
        self._rec.log(f"{self._root}/{entity}", item, static=True)

    def _send(self, entity: str, times_ns: IntArray, columns: Any) -> None:
        self._rec.send_columns(f"{self._root}/{entity}", times(times_ns), columns)

    def _due(self, what: str, times_ns: IntArray, period_ns: int) -> KeptRows:
        """Return the rows of a block that are to be sent: the first in each period since the last block."""
        k = every(times_ns, period_ns, self._last.get(what, -1))
        if len(k):
            self._last[what] = int(times_ns[k[-1]] // period_ns)
        return k

    def _static(self) -> None:
        if self._shape is None:
            self._log("vehicle/body/marker", rr.Points3D([[0, 0, 0]], radii=rr.Radius.ui_points(6)))
        axes, radius = 0.45 * self._size * np.diag([1.35, 0.35, 0.35]), 0.004 * self._size
        colours = [rgba(colour) for colour in (RED, "#22aa55", "#4477ff")]
        arrows = rr.Arrows3D(vectors=axes, colors=colours, radii=radius, labels=list("xyz"), show_labels=False)
        self._log("vehicle/body/axes", arrows)
        for name, colour in (("velocity", "#4cd07d"), ("wind", SKY)):
            style = rr.Arrows3D.from_fields(colors=rgba(colour), radii=0.006 * self._size, show_labels=True)
            self._log(f"vehicle/{name}", style)

    def _legend(self, sections: LoadStations) -> None:
        """Send a colour scale of the skin, upright next to the vehicle and behind it in the direction of flight."""
        azimuth = math.radians(self._place.site.azimuth_deg)
        forward = np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
        share = np.linspace(0.0, 1.0, 21)
        points = self._size * (-0.5 * forward + (share[:, None] - 0.5) * np.array([0.0, 0.0, 0.7]))
        colours = load_colours(0.5 * (share[1:] + share[:-1])) | np.uint32(255)
        strips = rr.LineStrips3D(np.stack([points[:-1], points[1:]], axis=1), colors=colours, radii=0.012 * self._size)
        self._log("vehicle/legend", strips)
        largest = f"maximum {self._largest_moment_Nm / 1e3:.3g} kN m"
        labels = ["0", "50 %", largest if sections.limit_Nm is None else "limit"]
        marks = rr.Points3D(points[::10], labels=labels, show_labels=True, radii=0.0, colors=rgba(WHITE))
        self._log("vehicle/legend/shares", marks)

    # -- blocks ----------------------------------------------------------------------------------------------------
    def add(self, channels: Channels) -> None:
        """Send the rows of a block. Blocks must follow one another in time."""
        if self._frames is None:
            self._frames = self._place.frames(channels.table, MOTION_NS if self._near else FAR_NS)
        path = path_of(channels, self._frames)
        if not len(path.times_ns):
            return
        self.track.append(path.translation_m)
        self._send("vehicle", path.times_ns, rr.Transform3D.columns(translation=path.translation_m))
        if not self._near:
            return
        self._trail(channels, path)
        turn = rr.Transform3D.columns(quaternion=path.rotation[:, [1, 2, 3, 0]])
        self._send("vehicle/body", path.times_ns, turn)
        self._arrows(channels)
        if self._shape is not None:
            self._vehicle(channels)

    def mark(self, moments: Sequence[Moment], path: FramePath) -> None:
        """Send points on the trajectory with names and times. Of several points close together, only the last is
        sent.
        """
        if not moments or not len(path.times_ns):
            return
        k = np.clip(np.searchsorted(path.times_ns, [m.time_ns for m in moments]), 0, len(path.times_ns) - 1)
        points, extent_m = path.translation_m[k], float(np.linalg.norm(np.ptp(path.translation_m, axis=0)))
        kept: list[int] = []
        for n in reversed(range(len(moments))):
            if all(np.linalg.norm(points[n] - points[other]) >= _MARKS_APART * extent_m for other in kept):
                kept.insert(0, n)
        moments, points = [moments[n] for n in kept], points[kept]
        labels, radius = [m.label for m in moments], rr.Radius.ui_points(4)
        self._log("marks", rr.Points3D(points, labels=labels, show_labels=True, radii=radius, colors=rgba(WHITE)))

    def whole_path(self, path: FramePath, colour: str) -> None:
        """Send the whole trajectory as a thin line."""
        points = path.translation_m[every(path.times_ns, 1_000_000_000)]
        self._log("path", rr.LineStrips3D([points], colors=rgba(colour, 0.7), radii=rr.Radius.ui_points(0.7)))

    def _trail(self, channels: Channels, path: FramePath) -> None:
        k = self._due("trail", path.times_ns, TRAIL_NS)
        if not len(k):
            return
        points, at = path.translation_m[k], path.times_ns[k]
        if self._trail_end is None:
            at = at[1:]
        else:
            points = np.concatenate([self._trail_end[None], points])
        self._trail_end = points[-1]
        if len(points) < 2:
            return
        burning = _at(channels, "thrust_N", at) > 0.0
        colours = np.where(burning[:, None], *self._trail_colours).astype("u1")
        strips = np.stack([points[:-1], points[1:]], axis=1).astype("f4")
        radii = np.full(len(at), -2.2, "f4")
        self._send("trail", at, rr.LineStrips3D.columns(strips=list(strips), colors=colours, radii=radii))

    def _arrows(self, channels: Channels) -> None:
        """Send arrows of the velocity over the ground, for its direction, and of the wind, to scale.

        Both are labelled with their magnitude.
        """
        if not all(f"v_N_{a}_mps" in channels for a in _NED):
            return
        ns = channels.time_ns("v_N_north_mps")
        k = self._due("arrows", ns, ARROWS_NS)
        if not len(k):
            return
        v = self._vectors(channels, "v_N_{}_mps", k)
        speed = np.linalg.norm(v, axis=1)
        grows = np.minimum(speed / 20.0, 1.0) / np.maximum(speed, 1e-9)
        self._send_arrow("velocity", ns[k], v * (0.75 * self._size * grows)[:, None], speed, "{:.0f} m/s")
        if all(f"wind_N_{a}_mps" in channels for a in _NED):
            wind = self._vectors(channels, "wind_N_{}_mps", k)
            keep = changed(wind, 0.05)
            wind = wind[keep]
            speed = np.linalg.norm(wind, axis=1)
            vectors = wind * (self._size / np.maximum(speed, 60.0))[:, None]
            self._send_arrow("wind", ns[k][keep], vectors, speed, "wind {:.0f} m/s")

    def _vectors(self, channels: Channels, pattern: str, k: KeptRows) -> Array:
        v_N = np.stack([channels[pattern.format(a)][k] for a in _NED], axis=1)
        return self._place.from_ned(channels["latitude_deg"][k], channels["longitude_deg"][k], v_N)

    def _send_arrow(self, name: str, ns: IntArray, vectors: Array, sizes: Array, text: str) -> None:
        labels = [text.format(x) if x > 3.0 else "" for x in np.nan_to_num(sizes)]
        columns = rr.Arrows3D.columns(vectors=np.nan_to_num(vectors).astype("f4"), labels=labels)
        self._send(f"vehicle/{name}", ns, columns)

    # -- the vehicle -----------------------------------------------------------------------------------------------
    def _vehicle(self, channels: Channels) -> None:
        assert self._shape is not None
        self._loaded = SECTION in channels
        ns = channels.time_ns("cg_station_m")
        numbers = np.nan_to_num(channels["stage"]).astype(int)
        for number in np.unique(numbers).tolist():
            rows = np.flatnonzero(numbers == number)
            begin_ns, end_ns = int(ns[rows[0]]), int(ns[rows[-1]])
            if number != self._stage:
                self._drop(self._shape, number, begin_ns, channels)
                self._change_stage(self._shape, number, begin_ns)
            cg = channels["cg_station_m"][rows]
            k = changed(cg[:, None], _LEVEL_STEP_M)
            shift = np.stack([cg[k], 0.0 * cg[k], 0.0 * cg[k]], axis=1)
            self._send("vehicle/body/hull", ns[rows][k], rr.Transform3D.columns(translation=shift))
            self._bend(self._shape, channels, begin_ns, end_ns)
            if self._loaded and (sections := self._shape.stages[number].sections) is not None:
                self._send_loads(self._shape, sections, channels, begin_ns, end_ns)

    def _send_loads(
        self, shape: VehicleShape, sections: LoadStations, channels: Channels, begin_ns: int, end_ns: int
    ) -> None:
        """Send the colour of each piece, from the bending moment at its middle."""
        ns = channels.time_ns(SECTION)
        inside = slice(*np.searchsorted(ns, [begin_ns, end_ns + 1]))
        k = self._due(f"loads{self._stage}", ns[inside], ARROWS_NS) + inside.start
        names = [f"section_{n}_bending_{{}}_Nm" for n in range(1, len(sections.station_m) + 1)]
        pitch, yaw = (np.stack([channels[name.format(plane)][k] for name in names], axis=1) for plane in PLANES)
        moments = np.nan_to_num(np.hypot(pitch, yaw))
        if (largest_Nm := float(moments.max(initial=0.0))) > self._largest_moment_Nm:
            self._largest_moment_Nm = largest_Nm
            self._legend(sections)
        joints = shape.joints(self._stage)
        shares = sections.shares(moments, self._largest_moment_Nm, 0.5 * (joints[1:] + joints[:-1]))
        colours = load_colours(shares)
        for i in range(len(joints) - 1):
            some = changed(shares[:, i : i + 1], _LOAD_STEP)
            columns = rr.Mesh3D.columns(albedo_factor=colours[some, i])
            self._send(f"vehicle/body/hull/stage{self._stage + 1}/piece_{i:02}/skin", ns[k][some], columns)

    def _drop(self, shape: VehicleShape, number: int, begin_ns: int, channels: Channels) -> None:
        """Send the separated boosters. They fall behind the core without thrust and drag, and drift outwards."""
        if self._stage < 0 or not shape.stages[number].keeps_clock:
            return
        staying = [booster.name for booster in shape.stages[number].boosters]
        ns = begin_ns + np.arange(0, _FALL_NS + 1, MOTION_NS)
        t = (ns - begin_ns)[:, None] / 1e9
        load_mps2 = STANDARD_GRAVITY_mps2 * float(_at(channels, "axial_load_g", ns[:1])[0])
        for booster in shape.stages[self._stage].boosters:
            if booster.name in staying:
                continue
            outward = np.array([0.0, *booster.position_m]) / max(math.hypot(*booster.position_m), 1e-9)
            moved = -0.5 * load_mps2 * t**2 * np.array([1.0, 0.0, 0.0]) + _DRIFT_mps * t * outward
            entity = f"vehicle/body/hull/left/{booster.name}"
            set_time(self._rec, begin_ns)
            self._rec.log(f"{self._root}/{entity}", booster_mesh(booster))
            self._send(entity, ns, rr.Transform3D.columns(translation=moved))
            set_time(self._rec, begin_ns + _FALL_NS)
            self._rec.log(f"{self._root}/{entity}", rr.Clear(recursive=True))
        self._rec.reset_time()

    def _change_stage(self, shape: VehicleShape, number: int, begin_ns: int) -> None:
        hull = f"{self._root}/vehicle/body/hull"
        set_time(self._rec, begin_ns)
        if self._stage >= 0:
            self._rec.log(f"{hull}/stage{self._stage + 1}", rr.Clear(recursive=True))
            if not shape.stages[number].keeps_clock:
                self._stage_start_ns = begin_ns
        self._stage = number
        for entity, item in vehicle_meshes(shape, number, self._loaded):
            self._rec.log(f"{hull}/stage{number + 1}/{entity}", item, static=len(shape.stages) == 1)
        self._rec.reset_time()

    def _bend(self, shape: VehicleShape, channels: Channels, begin_ns: int, end_ns: int) -> None:
        """Send the pieces, engines and liquids of the current stage between two times."""
        number, stage = self._stage, shape.stages[self._stage]
        hull = f"vehicle/body/hull/stage{number + 1}"
        ns = channels.time_ns("gimbal_pitch_angle_deg" if "gimbal_pitch_angle_deg" in channels else "cg_station_m")
        inside = slice(*np.searchsorted(ns, [begin_ns, end_ns + 1]))
        k = self._due(f"bend{number}", ns[inside], MOTION_NS) + inside.start
        if not len(k):
            return
        at = ns[k]
        clock_s = (at - self._stage_start_ns) / 1e9 * stage.clock_factor
        pitch, yaw, spatial = (modal_coordinates(channels, kind, k) for kind in (*PLANES, "spatial"))
        joints = shape.joints(number)
        gimbal = stage.engine.gimbal_station_m if stage.engine is not None else joints[-1]
        tanks = [tank for s in shape.stages[number:] for tank in s.tanks]
        ends = [x for tank in tanks for x in (tank.bottom_station_m, tank.top_station_m)]
        stations = np.concatenate([joints, [gimbal], ends])
        bent = bent_line(stage, clock_s, pitch, yaw, stations, spatial=spatial)
        turn = bent_line(stage, clock_s, pitch, yaw, np.array([gimbal]), "slope_pm", spatial)[:, 0]
        largest = np.maximum(np.abs(bent).max(axis=(1, 2)) * self._ex.bending, 1e-9)
        factor = self._ex.bending * np.minimum(1.0, self._ex.most_m / largest)
        bent, turn = bent * factor[:, None, None], turn * factor[:, None]
        self._send_pieces(hull, at, joints, bent)
        if stage.engine is not None:
            for name, engine in stage.nozzles:
                self._send_nozzle(f"{hull}/{name}", engine, channels, k, at, bent[:, len(joints)], turn)
            self._send_thrust(shape, f"{hull}/engine/thrust", stage.engine, channels, at)
        for i, tank in enumerate(tanks):
            first = len(joints) + 1 + 2 * i
            self._send_liquid(f"{hull}/liquid/{tank.name}", channels, tank, at, clock_s, bent[:, first : first + 2], k)

    def _send_pieces(self, hull: str, at: IntArray, joints: Array, bent: Array) -> None:
        for i, (a, b) in enumerate(itertools.pairwise(joints)):
            start, slope = bent[:, i], (bent[:, i + 1] - bent[:, i]) / (b - a)
            k = changed(bent[:, i : i + 2], _BEND_STEP_M)
            matrix = np.tile(np.eye(3).ravel(), (len(k), 1))  # by columns
            matrix[:, 1:3] = -slope[k]
            move = np.concatenate([np.full((len(k), 1), -a), start[k]], axis=1)
            columns = rr.Transform3D.columns(translation=move, mat3x3=matrices(matrix))
            self._send(f"{hull}/piece_{i:02}", at[k], columns)

    def _send_nozzle(
        self,
        entity: str,
        engine: EngineShape,
        channels: Channels,
        k: KeptRows,
        at: IntArray,
        shift: Array,
        slope: Array,
    ) -> None:
        pitch, yaw = np.zeros((2, len(at))) + np.radians(engine.cant_deg)[:, None]
        if f"{engine.channels}_pitch_angle_deg" in channels:
            names = [f"{engine.channels}_{axis}_angle_deg" for axis in PLANES]
            moved = [np.radians(np.nan_to_num(channels[name][k])) for name in names]
            pitch, yaw = pitch + engine.follows[0] * moved[0], yaw + engine.follows[1] * moved[1]
        # the axis is (cos p cos y, -sin y, sin p cos y); bending turns it by the slope at the gimbal
        tilt_y, tilt_z = -np.sin(yaw) - slope[:, 0], np.sin(pitch) * np.cos(yaw) - slope[:, 1]
        axis = np.stack([np.ones(len(at)), tilt_y, tilt_z], axis=1)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        quaternion = np.stack([0 * pitch, -axis[:, 2], axis[:, 1], 1.0 + axis[:, 0]], axis=1)  # turns x into the axis
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        moves = np.concatenate([np.full((len(at), 1), -engine.gimbal_station_m), shift + engine.offset_m], axis=1)
        sent = changed(np.concatenate([np.degrees(axis[:, 1:]), 50.0 * moves[:, 1:]], axis=1), _ANGLE_STEP_DEG * 5)
        turned = rr.Transform3D.columns(translation=moves[sent], quaternion=quaternion[sent])
        self._send(entity, at[sent], turned)

    def _send_thrust(
        self, shape: VehicleShape, entity: str, engine: EngineShape, channels: Channels, at: IntArray
    ) -> None:
        if "thrust_N" not in channels:
            return
        thrust = np.nan_to_num(_at(channels, "thrust_N", at))
        some = every(at, ARROWS_NS)
        some = some[changed(thrust[some][:, None], 50.0)]
        largest_N = float(np.nanmax(channels["thrust_N"], initial=0.0))
        self._largest_thrust_N = max(self._largest_thrust_N, math.floor(largest_N))
        length = 0.4 * shape.length_m * np.sqrt(np.clip(thrust[some] / self._largest_thrust_N, 0.0, 1.5))
        back = engine.exit_station_m - engine.gimbal_station_m
        zero = 0.0 * length
        arrows = rr.Arrows3D.columns(
            vectors=np.stack([length, zero, zero], 1),
            origins=np.stack([-back - length, zero, zero], 1),
            labels=[f"thrust {x / 1000.0:.3g} kN" if x > 0 else "" for x in thrust[some]],
        )
        self._send(entity, at[some], arrows)

    def _send_liquid(
        self, entity: str, channels: Channels, tank: TankShape, at: IntArray, clock_s: Array, shift: Array, k: KeptRows
    ) -> None:
        height = np.interp(clock_s, *tank.level)
        angles = np.zeros((len(at), 2))
        swings = re.compile(rf"slosh_(.*_or_)?{re.escape(tank.name)}(_or_.*)?_pitch_deg")
        if channel := next(filter(swings.fullmatch, channels.table.names), None):
            names = (channel.replace("_pitch_deg", f"_{plane}_deg") for plane in reversed(PLANES))
            angles = np.stack([np.nan_to_num(channels[name][k]) for name in names], axis=1)
        tilt = np.clip(np.tan(np.radians(np.clip(angles * self._ex.slosh, -80.0, 80.0))), -_STEEPEST, _STEEPEST)
        some = np.arange(0, len(at), 2)  # surfaces swing slowly
        state = np.concatenate([height[:, None] / 2.0, tilt * tank.radius_m, shift.reshape(len(at), -1) / 5.0], axis=1)
        some = some[changed(state[some], _LEVEL_STEP_M)]
        floor = np.full(len(some), -tank.bottom_station_m)
        # the position of the surface between floor and roof determines its displacement along the bent line
        share = np.clip(height[some] / (tank.bottom_station_m - tank.top_station_m), 0.0, 1.0)[:, None]
        low, high = shift[some, 0], shift[some, 0] * (1.0 - share) + shift[some, 1] * share
        vertices = liquid_vertices(
            floor, floor + height[some], 0.97 * tank.radius_m, tilt[some], np.stack([low, high], axis=1)
        )
        columns = rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3))
        self._send(entity, at[some], columns.partition([vertices.shape[1]] * len(some)))


def _at(channels: Channels, name: str, at_ns: IntArray) -> Array:
    """Return the last values of a channel at or before the given times, or zeros without the channel."""
    if name not in channels or not len(channels.time_ns(name)):
        return np.zeros(len(at_ns))
    return channels[name][last_before(channels.time_ns(name), at_ns)]


# -- the ground ----------------------------------------------------------------------------------------------------
def send_ground(recording: rr.RecordingStream, place: ShownLaunchSite, reach_m: float, drop_m: float) -> str:
    """Send a grid on the Earth's surface over the range of the flight, and the pad, as static data.

    Return the spacing of the grid as text. The simulation begins with the CG at the site's altitude, so the ground is
    drawn `drop_m` lower, under the vehicle.
    """

    def lines(entity: str, strips: Iterable[Array], colour: Sequence[int], radius: Any) -> None:
        recording.log(f"ground/{entity}", rr.LineStrips3D(list(strips), colors=colour, radii=radius), static=True)

    step = 10.0 ** math.floor(math.log10(max(reach_m, 100.0) / 2.0))
    if reach_m / step > 12:
        step *= 5.0
    count = math.ceil(1.15 * reach_m / step)
    along, drop = np.linspace(-count * step, count * step, 16 * count + 1), np.array([0.0, 0.0, drop_m])
    offsets = [np.full(len(along), (i + 0.5) * step) for i in range(-count, count + 1)]  # off the site
    pairs = [pair for across in offsets for pair in ((along, across), (across, along))]
    thin = rr.Radius.ui_points(0.5)
    lines("grid", (place.ground(*pair) - drop for pair in pairs), _GRID, thin)
    x, y = np.meshgrid(np.linspace(-60.0, 60.0, 13), np.linspace(-60.0, 60.0, 13), indexing="ij")
    pad = np.stack([x, y, np.full_like(x, -drop_m)], axis=-1)
    lines("pad", [*pad, *pad.swapaxes(0, 1)], _PAD, 0.05)
    corners = [(-4.0, -4.0), (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0)]
    block = plate([(x, y, -drop_m - 0.3) for x, y in corners], 0.6)
    recording.log("ground/pad/block", mesh3d(block, _BLOCK), static=True)
    ends = compass_ends(place, reach_m)
    arrows = rr.Arrows3D(vectors=ends, origins=np.zeros((2, 3)), colors=_COMPASS, radii=rr.Radius.ui_points(1.0))
    recording.log("ground/compass", arrows, static=True)
    names = rr.Points3D(1.15 * ends, labels=["E", "N"], show_labels=True, colors=_COMPASS, radii=thin)
    recording.log("ground/compass/names", names, static=True)
    return f"{step / 1000.0:g} km" if step >= 1000.0 else f"{step:g} m"


def compass_ends(place: ShownLaunchSite, reach_m: float) -> Array:
    """Return the ends of the arrows to east and north, (2, 3), m."""
    return place.ground(np.array([0.12 * reach_m, 0.0]), np.array([0.0, 0.12 * reach_m]))


def tail_below_cg(channels: Channels, shape: VehicleShape | None) -> float:
    """Return the distance from the CG to the aft end of the vehicle at the start of the flight, m."""
    if shape is None or "cg_station_m" not in channels or not len(channels["cg_station_m"]):
        return 0.0
    stage = shape.stages[0]
    end = stage.engine.exit_station_m if stage.engine is not None else stage.end_m
    return max(float(end - channels["cg_station_m"][0]), 0.0)
