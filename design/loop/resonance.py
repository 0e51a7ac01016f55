"""The poles of the fixed part of a loop, each with the name of the component that owns it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.design.loop.own_part import centre_of, folded_hz
from maxq.design.model.state_space import ComplexArray, StateSpace


@dataclass(frozen=True)
class Resonance:
    """An oscillatory pole of the open loop.

    `frequency_hz` is the frequency at which it appears in the response, folded below the Nyquist frequency in a sampled
    loop. `pole_radps` is the unfolded pole with positive imaginary part. `number` counts from 1 (tank, mode, section).
    """

    kind: str  # "bending", "slosh", "engine" (on its compliance), "actuator", "gyro", "body", "hold", ...
    number: int
    frequency_hz: float
    pole_radps: complex
    highest_hz: float = math.inf  # highest frequency of the loop
    part: complex = complex(math.nan, math.nan)  # own part / whole response at `centre_hz`; NaN unless a bending mode

    @property
    def centre_hz(self) -> float:
        """Return the frequency at which the resonance is examined.

        It is `centre_of` for a bending mode, and `frequency_hz` otherwise.
        """
        bends = not math.isnan(self.part.real)
        return centre_of(self.frequency_hz, self.half_width_hz, self.highest_hz) if bends else self.frequency_hz

    @property
    def label(self) -> str:
        return f"{self.kind} {self.number}" if self.kind in ("bending", "slosh", "actuator") else self.kind

    @property
    def damping_ratio(self) -> float:
        return -self.pole_radps.real / abs(self.pole_radps)

    @property
    def half_width_hz(self) -> float:
        """Return the distance from `frequency_hz` at which the resonance is 3 dB below its peak."""
        return abs(self.pole_radps.real) / (2.0 * math.pi)


@dataclass(frozen=True)
class NamedPole:
    """A pole in rad/s, and the kind and number of the component that owns it."""

    pole_radps: complex
    kind: str
    number: int = 0
    residue: ComplexArray | None = None  # (outputs, inputs) of the vehicle; None for a real pole or another component


def named(poles: ComplexArray, kind: str, number: int = 0) -> list[NamedPole]:
    return [NamedPole(complex(p), kind, number) for p in poles]


def vehicle_poles(plant: StateSpace) -> list[NamedPole]:
    """Return the poles of a vehicle with the states of `vehicle_plant`, or some of them, named by participation.

    The participation of a pole in a state is the product of the corresponding elements of its right and left
    eigenvectors. It is independent of units, and its sum over the states is one (Perez-Arriaga, Verghese & Schweppe,
    IEEE Trans. PAS-101, 1982). Each oscillator gives its name to one pole pair, so that two tanks of equal frequency
    are distinguished even if their motions are coupled.
    """
    poles, vectors = np.linalg.eig(plant.a) if len(plant.a) else (np.zeros(0), np.zeros((0, 0)))
    poles = poles.astype(np.complex128)
    names = [owner_of(state) for state in plant.states]
    owners = list(dict.fromkeys(names))
    left = np.linalg.pinv(vectors) if len(poles) else vectors
    share = np.abs(vectors * left.T)
    per_owner = np.array([[share[[n == o for n in names], i].sum() for o in owners] for i in range(len(poles))])
    out = []
    swinging = [i for i in range(len(poles)) if poles[i].imag > 0.0]
    if swinging:
        found = list(enumerate(per_owner[swinging].argmax(axis=1).tolist()))
        if len({owner for _, owner in found}) < len(found):  # two poles share their largest participation
            found = list(zip(*map(list, scipy.optimize.linear_sum_assignment(-per_owner[swinging])), strict=True))
        for pair, owner in found:
            pole = complex(poles[swinging[pair]])
            residue = np.outer(plant.c @ vectors[:, swinging[pair]], left[swinging[pair]] @ plant.b)
            out.append(NamedPole(pole, *owners[int(owner)], residue))
            out.append(NamedPole(pole.conjugate(), *owners[int(owner)], residue.conj()))
    for i in np.flatnonzero(poles.imag == 0.0):
        out.append(NamedPole(complex(poles[i]), *owners[int(np.argmax(per_owner[i]))]))
    return out


def owner_of(state: str) -> tuple[str, int]:
    found = re.match(r"(eta|slosh)_(\d+)_", state)
    if state.startswith("engine_"):
        return "engine", 0
    if found is None:
        return "body", 0
    return ("bending" if found[1] == "eta" else "slosh"), int(found[2])


def resonances(poles: list[NamedPole], below_zeta: float, sample_s: float | None) -> list[Resonance]:
    """Return the oscillatory poles with a damping ratio below `below_zeta`, in rising order of frequency."""
    out, highest_hz = [], math.inf if sample_s is None else 0.5 / sample_s
    for p in poles:
        if p.pole_radps.imag <= 0.0 or -p.pole_radps.real >= below_zeta * abs(p.pole_radps):
            continue
        frequency_hz = float(folded_hz(p.pole_radps.imag / (2.0 * math.pi), 1.0 / (sample_s or 1e-300)))
        out.append(Resonance(p.kind, p.number, frequency_hz, p.pole_radps, highest_hz))
    return sorted(out, key=lambda r: r.frequency_hz)
