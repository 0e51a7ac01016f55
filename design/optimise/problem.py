"""Problem (42) to (50) at a point of the variables: every peak, crossing and limit, with gradients.

Everything is in decibels, a phase by the gain margin over the phase margin (6 dB for 30 deg: 0.2 dB/deg), so that a
violation means much the same whatever it violates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.optimise import features
from maxq.design.optimise.curves import Curves, Indices
from maxq.design.optimise.features import DB, Bands, Cross, Kind, LogLoop, Mask, Places
from maxq.design.optimise.limits import CommonLimits, Limits, PlantLimits
from maxq.design.optimise.loops import Loops
from maxq.design.optimise.rows import Collected, Rows, What, plain_rows

FARTHEST_DB = 20.0  # rows that are met by more are left out
WIDEST_ZONE = 2.5  # approaches to a zone that are rows


@dataclass(frozen=True)
class Rigid:
    """Derivatives of the vehicles, (plants,): M_delta, M_alpha (1/s2) and M_q (1/s)."""

    m_delta: Array
    m_alpha: Array
    m_q: Array


@dataclass(frozen=True)
class Evaluation:
    """The problem at a point; `gradient` (rows, variables) of the rows' excess."""

    variables: Array
    rows: Rows
    gradient: Array
    objective_db: float
    violation_db: float  # largest excess, 0 where every limit is met
    unstable: int  # unstable closed-loop poles over all plants


@dataclass(frozen=True)
class _Judged:
    """Features number `which` held to one limit, with arrays of their own."""

    which: Indices
    what: What
    value: Array
    limit: Array
    excess_db: Array
    objective: bool


class Problem:
    """Loops with limits and bounds of the variables."""

    def __init__(
        self, loops: Loops, bands: Bands, rigid: Rigid, limits: Sequence[Limits], common: CommonLimits, lower: Array,
        upper: Array, least_margin: bool = False,
    ) -> None:  # fmt: skip
        """`limits` of each plant. `least_margin`: the objective is the least |1 + L|, not the first mode's peak."""
        self.loops, self.bands, self.rigid = loops, bands, rigid
        self.limits, self.common = PlantLimits(limits), common
        self.lower, self.upper = lower, upper
        self.least_margin = least_margin
        self.cross = Cross(self.limits.gain_margin_db / DB, np.radians(self.limits.phase_margin_deg), common.zone)
        self._mesh_cross = self.cross.of(loops.curves.plant)
        self.evaluations = 0

    @property
    def size(self) -> int:
        return self.loops.size

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.loops.filter.names, *self.loops.gains.names)

    def evaluate(self, variables: Array, complete: bool = False) -> Evaluation:
        """Everything at a point; `complete`: with rows that are met by far. Raises ValueError for variables not
        finite.
        """
        if not np.isfinite(variables).all():
            raise ValueError("variables are not finite")
        self.evaluations += 1
        loops = self.loops
        y, u = loops.split(variables)
        k_p, k_d = loops.gains.at_plants(u)
        loop = loops.response(variables)
        places = self._places(loop)
        plant = loops.curves.plant[places.cell]
        x, at = loops.refined(y, k_p[plant], k_d[plant], places, self.cross.of(plant))
        collected = Collected()
        self._add_features(collected, replace(places, x=x), at, y, math.inf if complete else FARTHEST_DB)
        self._add_rigid(collected, k_p, k_d)
        self._add_filter(collected, y)
        rows = collected.joined()
        limits, objective = rows.excess_db[~rows.objective], rows.excess_db[rows.objective]
        return Evaluation(
            variables,
            rows,
            self._expanded(rows.own, rows.plant, u),
            float(objective.max(initial=-1e3)),
            float(limits.max(initial=0.0)),
            int(loops.unstable_poles(loop).sum()),
        )

    def _expanded(self, own: Array, plant: Indices, u: Array) -> Array:
        """Gradients by all variables from those by the own plant's gains; plant -1 has none."""
        n = self.loops.filter.size
        out = np.zeros((len(own), self.size))
        out[:, :n] = own[:, :n]
        if self.loops.gains.size > 0:
            by_p, by_d = self.loops.gains.log_gradients(u)
            out[:, n:] = own[:, n, None] * by_p[plant] + own[:, n + 1, None] * by_d[plant]
        return out

    # --- features
    def _places(self, loop: NDArray[np.complex128]) -> Places:
        log_gain = np.log(np.abs(loop) + 1e-300)
        beside = np.angle(-loop)
        curves, limits = self.loops.curves, self.limits
        found = [
            self.bands.peaks(curves, log_gain),
            features.crossings(curves, loop, log_gain),
            features.ends(curves, loop, self.loops.poles_at_zero == 0),
            features.turns(curves, log_gain, beside, self._mesh_cross),
        ]
        if self.least_margin or not np.isnan(limits.modulus_db).all():
            found.append(features.nearest(curves, np.abs(1.0 + loop), Kind.MODULUS, 1.0))
        if self.common.zone != "none":
            found.append(features.near_zone(curves, log_gain, beside, self._mesh_cross, WIDEST_ZONE))
        return features.in_intervals(curves, features.joined(found))

    def _add_features(self, rows: Collected, places: Places, at: LogLoop, y: Array, farthest_db: float) -> None:
        limits, kind, plant = self.limits, places.kind, self.loops.curves.plant[places.cell]
        gain_db, beside_deg = at.value.real * DB, np.degrees(features.wrapped(at.value))
        mode = np.zeros(len(kind), np.int64)
        mode[kind == Kind.PEAK] = self.bands.mode[places.tag[kind == Kind.PEAK]]
        cross = self.cross.of(plant)
        per_deg = np.radians(cross.db_per_rad)
        parts: list[_Judged] = []

        def add(where: Mask, what: What, value: Array, limit: Array, excess: Array, objective: bool = False) -> None:
            """Rows where there is a limit (excess is no nan) and it is not met by far."""
            worst = float(excess[where].max(initial=-np.inf)) if objective else 0.0
            i = np.flatnonzero(where & (excess > worst - farthest_db))
            if len(i) > 0:
                parts.append(_Judged(i, what, value[i], limit[i], excess[i], objective))

        none = np.full(len(kind), np.nan)
        first = mode == 1
        if not self.least_margin:
            add(first, What.FIRST_MODE, gain_db, none, gain_db, True)
        for where, what, most in (
            (first, What.FIRST_MODE, limits.first_mode_db[plant]),
            (mode == 2, What.SECOND_MODE, limits.second_mode_db[plant]),
            (mode > 2, What.HIGHER_MODES, limits.higher_modes_db[plant]),
        ):
            add(where, what, gain_db, most, gain_db - most)
        least, wanted = limits.gain_margin_db[plant], limits.phase_margin_deg[plant]
        crossing = (kind == Kind.GAIN_CROSSING) | (kind == Kind.END)
        add(crossing, What.GAIN_MARGIN, gain_db, least, least - np.abs(gain_db))
        crossing, lobe = kind == Kind.PHASE_CROSSING, limits.first_mode_phase_deg[plant]
        inside = crossing & ~np.isnan(lobe) & self._in_first_band(places)
        add(inside, What.FIRST_MODE_PHASE, beside_deg, lobe, (lobe - np.abs(beside_deg)) * per_deg)
        add(crossing & ~inside, What.PHASE_MARGIN, beside_deg, wanted, (wanted - np.abs(beside_deg)) * per_deg)
        turn = (kind == Kind.GAIN_TURN) & (np.abs(beside_deg) < wanted)
        add(turn, What.PHASE_MARGIN, gain_db, none, -np.abs(gain_db))
        turn = (kind == Kind.PHASE_TURN) & (np.abs(gain_db) < least)
        add(turn, What.GAIN_MARGIN, beside_deg, none, -np.abs(beside_deg) * per_deg)
        near, distance = kind == Kind.MODULUS, none.copy()
        distance[near] = DB * np.log(np.abs(1.0 + np.exp(at.value[near])))
        add(near, What.MODULUS, distance, limits.modulus_db[plant], limits.modulus_db[plant] - distance)
        if self.least_margin:
            add(near, What.MODULUS, distance, none, -distance, True)
        near = (kind == Kind.ZONE) | (kind == Kind.ZONE_CORNER)
        if near.any():
            value = features.zone_value(at.value.real, np.radians(beside_deg), cross)
            add(near, What.ZONE, value, np.ones(len(kind)), (1.0 - value) * least)
        if parts:
            rows.add(self._feature_rows(parts, places, at, y))

    def _feature_rows(self, parts: list[_Judged], places: Places, at: LogLoop, y: Array) -> Rows:
        i = np.concatenate([p.which for p in parts])
        here = LogLoop(at.value[i], at.first[i], at.second[i], at.proportional[i], at.s[i])
        plant, sizes = self.loops.curves.plant[places.cell[i]], [len(p.which) for p in parts]
        return Rows(
            np.repeat(np.array([p.what for p in parts], np.int8), sizes), plant,
            np.concatenate([p.value for p in parts]), np.concatenate([p.limit for p in parts]),
            np.concatenate([p.excess_db for p in parts]), np.repeat([p.objective for p in parts], sizes),
            self._own_gradient(places.kind[i], plant, here, y),
            places.kind[i], places.cell[i], places.x[i], places.fixed[i],
        )  # fmt: skip

    def _own_gradient(self, kind: NDArray[np.int8], plant: Indices, at: LogLoop, y: Array) -> Array:
        c = features.sensitivity(kind, at, self.cross.of(plant))
        return np.asarray((c[:, None] * self.loops.own_gradient(y, at)).real)

    def _in_first_band(self, places: Places) -> Mask:
        curves = self.loops.curves
        plant, inside = curves.plant[places.cell], np.zeros(len(places.x), bool)
        for i in np.flatnonzero(self.bands.mode == 1):
            low, high = curves.x[[self.bands.first[i], self.bands.last[i]]]
            inside |= (plant == self.bands.plant[i]) & (places.x >= low) & (places.x <= high)
        return inside

    # --- limits that belong to no frequency
    def _add_rigid(self, rows: Collected, k_p: Array, k_d: Array) -> None:
        """(47) and (48)."""
        limits, plants = self.limits, np.arange(len(k_p))
        omega, zeta, by_omega, by_zeta = self.rigid_body(k_p, k_d)
        hz = omega / (2.0 * math.pi)
        for what, value, least, by in (
            (What.RIGID_FREQUENCY, hz, limits.rigid_hz, by_omega),
            (What.RIGID_DAMPING, zeta, limits.rigid_zeta, by_zeta),
        ):
            k = np.flatnonzero(least > 0.0)
            rows.add(plain_rows(what, plants[k], value[k], least[k], DB * np.log(least[k] / value[k]), -DB * by[k]))

    def rigid_body(self, k_p: Array, k_d: Array) -> tuple[Array, Array, Array, Array]:
        """omega (rad/s) and zeta, (plants,), and own gradients of their logarithms.

        "paper": (35) and (36), s2 + M_delta k_d s + M_delta k_p. "aerodynamic" (erratum 12):
        s2 + (M_delta k_d - M_q) s + M_delta k_p - M_alpha.
        """
        r, full, n = self.rigid, self.common.rigid_body == "aerodynamic", self.loops.filter.size
        spring, damper = r.m_delta * k_p, r.m_delta * k_d
        stiffness = np.maximum(spring - (r.m_alpha if full else 0.0), 1e-9)
        damping = np.maximum(damper - (r.m_q if full else 0.0), 1e-9)
        omega = np.sqrt(stiffness)
        by_omega, by_zeta = np.zeros((len(k_p), n + 2)), np.zeros((len(k_p), n + 2))
        by_omega[:, n] = 0.5 * spring / stiffness
        by_zeta[:, n], by_zeta[:, n + 1] = -by_omega[:, n], damper / damping
        return omega, damping / (2.0 * omega), by_omega, by_zeta

    def _add_filter(self, rows: Collected, y: Array) -> None:
        """(46)."""
        most, filter_ = self.common.filter_gain_at_infinity, self.loops.filter
        if most is None or filter_.size == 0:
            return
        slope = filter_.log_gain_at_infinity()
        gain = math.exp(float(slope @ y))
        own = np.concatenate([DB * slope, np.zeros(2)])[None]
        excess = np.array([DB * math.log(gain / most)])
        rows.add(plain_rows(What.FILTER_AT_INFINITY, np.array([-1]), np.array([gain]), np.array([most]), excess, own))

    # --- curvature
    def curvature(self, at: Evaluation, multipliers: Array, step: float = 1e-5) -> Array:
        """Second derivatives (variables, variables) of the rows' sum weighted with `multipliers`.

        By differences of the analytic gradient. A feature of a plant depends on the filter and on that plant's two
        gains only: so all k_p are moved at once, and all k_d, whatever the number of nodes.
        """
        loops, n = self.loops, self.loops.filter.size
        y, u = loops.split(at.variables)
        k_p, k_d = loops.gains.at_plants(u)
        rows = at.rows.taken(multipliers > 0.0)
        weight = multipliers[multipliers > 0.0]
        plants = len(k_p)
        moves = np.concatenate([np.eye(n + 2), -np.eye(n + 2)]) * step
        own = self._own_again(rows, y, k_p, k_d, moves)
        change = weight[:, None] * (own[: n + 2] - own[n + 2 :]) / (2.0 * step)  # (moves, rows, filter + 2)
        by_gains = np.zeros((n + 2, plants + 1, 2))  # the last plant takes what belongs to none
        for r, plant in enumerate(rows.plant):
            by_gains[:, plant] += change[:, r, n:]
        by_gains = by_gains[:, :plants]
        by_p, by_d = loops.gains.log_gradients(u)
        out = np.zeros((self.size, self.size))
        out[:n, :n] = change[:n, :, :n].sum(axis=1)
        if loops.gains.size > 0:
            out[:n, n:] = by_gains[:n, :, 0] @ by_p + by_gains[:n, :, 1] @ by_d
            out[n:, :n] = out[:n, n:].T
            for move, by in ((n, by_p), (n + 1, by_d)):
                out[n:, n:] += (by.T * by_gains[move, :, 0]) @ by_p + (by.T * by_gains[move, :, 1]) @ by_d
            slopes = np.zeros((plants + 1, 2))
            for r, plant in enumerate(rows.plant):
                slopes[plant] += weight[r] * rows.own[r, n:]
            # ln k = ln(sum of weights times exp(u)) bends with u: diag(share) - share share'
            for by, slope in ((by_p, slopes[:plants, 0]), (by_d, slopes[:plants, 1])):
                out[n:, n:] += np.diag(slope @ by) - (by.T * slope) @ by
        return np.asarray(0.5 * (out + out.T))

    def _own_again(self, rows: Rows, y: Array, k_p: Array, k_d: Array, moves: Array) -> Array:
        """Own gradients of the same rows, (moves, rows, filter + 2), after `moves` of filter, ln k_p and ln k_d."""
        n, count = self.loops.filter.size, len(moves)
        own = np.repeat(rows.own[None], count, axis=0)
        i = np.flatnonzero(rows.feature >= 0)
        if len(i) > 0:
            again = np.tile(i, count)
            move = np.repeat(np.arange(count), len(i))
            places = Places(
                rows.feature[again], rows.cell[again], rows.x[again], np.zeros(len(again), np.int64), rows.fixed[again]
            )
            moved_y = y + moves[move, :n]
            plant = rows.plant[again]
            own_p, own_d = k_p[plant] * np.exp(moves[move, n]), k_d[plant] * np.exp(moves[move, n + 1])
            at = self.loops.refined(moved_y, own_p, own_d, places, self.cross.of(plant))[1]
            own[:, i] = self._own_gradient(places.kind, plant, at, moved_y).reshape(count, len(i), n + 2)
        if self.common.rigid_body != "paper":
            for m, move_ in enumerate(moves):
                by_omega, by_zeta = self.rigid_body(k_p * math.exp(move_[n]), k_d * math.exp(move_[n + 1]))[2:]
                for what, by in ((What.RIGID_FREQUENCY, by_omega), (What.RIGID_DAMPING, by_zeta)):
                    k = rows.what == what
                    own[m, k] = -DB * by[rows.plant[k]]
        return own


def bands_of(curves: Curves, bands_hz: Sequence[Sequence[tuple[int, float, float]]]) -> Bands:
    """Bands (mode, low, high) of every plant as mesh points; ends are mesh points that `Curves` was told to keep."""
    found: list[tuple[int, int, int, int]] = []
    for p, bands in enumerate(bands_hz):
        begin, end = int(curves.start[p]), int(curves.start[p + 1])
        f = curves.frequency_hz[begin:end]
        for mode, low, high in bands:
            i = int(np.searchsorted(f, low * (1.0 - 1e-9)))
            j = int(np.searchsorted(f, high * (1.0 + 1e-9))) - 1
            if j > i:
                found.append((begin + i, begin + j, mode, p))
    columns = np.array(found, np.int64).reshape(-1, 4).T
    return Bands(columns[0], columns[1], columns[2], columns[3])
