"""Colours of all pictures: the set of Okabe & Ito, which the colour-blind can tell apart."""

from __future__ import annotations

BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE, GREY = (
    "#000000", "#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7", "#8a8f98",
)  # fmt: skip
ON_DARK = (SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILION)
ON_LIGHT = (BLUE, ORANGE, GREEN, PURPLE, VERMILION, SKY)
LIMIT = VERMILION
OF_VERDICT = {"passed": GREEN, "failed": VERMILION, "unknown": SKY}


def rgba(colour: str, alpha: float = 1.0) -> list[int]:
    """Four bytes of a `#rrggbb`."""
    return [*(int(colour[i : i + 2], 16) for i in (1, 3, 5)), round(255 * alpha)]
