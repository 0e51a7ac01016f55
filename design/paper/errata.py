"""The errata of the printed model of Lee, Ahn & Roh, each with a switch.

`PAPER` represents eqs 1 to 29 as printed. `CORRECTED` represents the physics of the simulator
(sim/vehicle/derivative.py). The numbers are those of the project's list of errata. Errata that do not change a linear
loop have no switch (3: weight bends no free-free mode; 9: signs that are right; 11, 12, 17 to 21: matters of the design
problem). Errata 14 (coefficients that the paper omits) and 15 (continuous approximations) correspond to the kinds of
loop in design/loop/fixed_path.py, and 16 (the loop that eq. 42 opens) to its cuts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple


class Erratum(NamedTuple):
    """The description of a switch of `Errata`."""

    number: str
    equations: str
    printed: str
    corrected: str


@dataclass(frozen=True)
class Errata:
    """The switches, one field for each erratum: True for corrected, False for as printed. `ABOUT` describes each."""

    gyro_senses_rate: bool = True
    mode_force_sign: bool = True
    bent_body_loads: bool = True
    axial_softening: bool = True
    core_mass: bool = True
    tank_radius: bool = True
    tank_liquid: bool = True
    engine_inertia: bool = True
    engine_weight: bool = True
    path_terms: bool = True
    jet_damping: bool = True
    damper_at_bob: bool = True
    actuator_labels: bool = False  # as printed in both presets, since the correct assignment is unknown

    def switched(self, **fields: bool) -> Errata:
        """Return the errata with some switches changed. Raises ValueError for an unknown name."""
        names = [f.name for f in dataclasses.fields(self)]
        for name in fields:
            if name not in names:
                raise ValueError(f"erratum {name!r}: known are {', '.join(names)}")
        return dataclasses.replace(self, **fields)


ABOUT: dict[str, Erratum] = {
    "gyro_senses_rate": Erratum("1", "12", "q_b = sum sigma eta, an angle", "q_b = sum sigma eta'"),
    "mode_force_sign": Erratum("2", "13", "-F_G / M_G", "+F_G / M_G with phi positive in +z as in (21)"),
    "bent_body_loads": Erratum(
        "4",
        "1, 2, 16, 17",
        "thrust, lift and tank loads of the bent body in the modal force only",
        "they also push and turn the whole body, thrust with its moment about the CG at the displaced gimbal",
    ),
    "axial_softening": Erratum("4", "13", "none", "axial compression softens the modes: it belongs to the follower"),
    "core_mass": Erratum("5", "1, 2, 21, 26, 27", "total mass, inertia and CG", "those without the sloshing masses"),
    "tank_radius": Erratum("6", "22, 25", "R is the diameter", "R is the radius"),
    "tank_liquid": Erratum("7", "25", "m is all propellant", "m is the liquid in this tank"),
    "engine_inertia": Erratum(
        "8", "14, 20", "I_E about the engine's own CG, no I_E sigma in the modal force", "I_E about the gimbal, in both"
    ),
    "engine_weight": Erratum("8", "2, 14", "none", "axial load on the engine's mass as it swings out"),
    "path_terms": Erratum(
        "10", "1", "alpha' = dF/mU + q only", "gravity turning with the body, drag along the wind, moving CG"
    ),
    "jet_damping": Erratum("10", "1, 2", "none", "mass flow damps the turning"),
    "damper_at_bob": Erratum(
        "22",
        "27",
        "liquid friction pulls at the hinge, as the rod does",
        "it pulls at the bob: else angular momentum is not conserved",
    ),
    "actuator_labels": Erratum(
        "13",
        "28",
        "zero 15.6 Hz, pole 52.6 Hz (a piston's response)",
        "a3 and a4 exchanged: pole 15.6 Hz, zero 52.6 Hz (an engine's response)",
    ),
}

CORRECTED = Errata()
PAPER = Errata(**dict.fromkeys(ABOUT, False))
PRESETS = {"corrected": CORRECTED, "paper": PAPER}


def one_at_a_time() -> Iterator[tuple[str, Errata]]:
    """Yield the name and the switches of each erratum switched alone, from its corrected to its printed form.

    The actuator's labels are switched from printed to exchanged.
    """
    for name in ABOUT:
        yield name, CORRECTED.switched(**{name: not getattr(CORRECTED, name)})
