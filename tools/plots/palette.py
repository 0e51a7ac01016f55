"""The colours of all pictures, on paper and in the viewer. They are those of Okabe & Ito, which colour-blind people can
distinguish.

This module imports nothing, so that the modules for the viewer do not load Matplotlib.
"""

from __future__ import annotations

BLUE, ORANGE, GREEN, RED, SKY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9"
PURPLE, YELLOW, BLACK, WHITE, GREY, PALE = "#cc79a7", "#f0e442", "#000000", "#ffffff", "#777777", "#dddddd"
ON_LIGHT = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY, BLACK)
"""The colours of curves on white, in this order."""
ON_DARK = (SKY, ORANGE, GREEN, PURPLE, YELLOW, RED)
"""The colours of curves on the viewer's dark background."""
FAILED = (RED, "#a34700", "#ff7733", "#7a3500", "#ff9d6e", "#ffc9ae")
"""The colours of failed flights that are shown among a few others: shades of one colour, never green."""
LIMIT = RED
VERDICT = {"passed": GREEN, "failed": RED, "unknown": SKY}


def rgba(colour: str, alpha: float = 1.0) -> list[int]:
    """Return the four bytes (red, green, blue, alpha) of a `#rrggbb` colour."""
    return [*bytes.fromhex(colour[1:]), round(255 * alpha)]
