"""Colours of the page, by role, as #rrggbb."""

from approxjac.view.style import AT_LIMIT, BELIEVED, COLORS, FORCE, SATURATED, TARGET, TRUE

MEASURED = "#56B4E9"
"""What was measured, where it differs from what is true."""
ARM = "#C9CED4"
"""The true arm, a grey that leaves the other colours their meaning."""
OBJECT = "#8C97A3"
"""The object that it holds."""
GRID = "#DDE1E6"
SKY, FLOOR = "#FDFDFE", "#F1F3F5"
"""Top and bottom of the background."""


def by_role() -> dict[str, str]:
    """All of them, by the names that page.js calls them by."""
    return {
        "true": TRUE,
        "believed": BELIEVED,
        "target": TARGET,
        "saturated": SATURATED,
        "atLimit": AT_LIMIT,
        "force": FORCE,
        "measured": MEASURED,
        "arm": ARM,
        "object": OBJECT,
    }


def series(count: int) -> list[str]:
    """Colours of a plot's lines, in turn, as in `approxjac.view`'s plots."""
    return [COLORS[i % len(COLORS)] for i in range(count)]


def as_number(colour: str) -> int:
    """#rrggbb as three.js counts it."""
    return int(colour[1:], 16)


def as_rgb(colour: str) -> list[float]:
    """#rrggbb as red, green and blue from 0 to 1."""
    return [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
