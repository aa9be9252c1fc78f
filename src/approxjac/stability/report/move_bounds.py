"""`Moves`: how fast a target may move along lines, with bounds of ‖e‖ and of the joints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from approxjac.formatting import display_unit, joined, numbers
from approxjac.stability.rows import Row
from approxjac.validation import Array

_PROMISE = (
    "for every robot of the box, from rest; nothing is assumed about staying; certified (a search "
    "found nothing against it), not proven"
)


@dataclass(frozen=True, eq=False, repr=False)
class Move:
    """A move along a line, eased from rest to rest, that every robot of the box makes as promised.

    At rest with the target at its tip, each stays within these bounds while the target moves with
    its feed-forward, and afterwards: nothing is assumed about staying in a region. Certified: a
    search over robots, places and errors found nothing against it. Not proven.

    Attributes:
        displacement: Of the target, shape (m,) [unit of the task].
        speed: Largest speed of the target [unit of the task/s]; 0 if none is certified.
        duration: Of the move at this speed [s]; infinite at 0.
        error: Bound of ‖e‖ [unit of the task].
        deviation: Bounds of the distance of each joint from the path that its robot takes if it
            moves slowly, shape (n_v,) [rad or m].
        rate: ρ: after the end the bound of ‖e‖ falls as exp(−ρt) [1/s].
        reason: Why no speed is certified; "" if one is.
        labels: Names of the task's coordinates.
        units: Units of the task's coordinates, and of the joints.
    """

    displacement: Array
    speed: float
    duration: float
    error: float
    deviation: Array
    rate: float
    reason: str
    labels: tuple[str, ...]
    units: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def way(self) -> str:
        """The direction, such as "+x"."""
        (moving,) = np.nonzero(self.displacement)
        if len(moving) > 1:
            return numbers(self.displacement)
        return f"{'+-'[int(self.displacement[moving[0]] < 0.0)]}{self.labels[moving[0]]}"

    @property
    def length(self) -> str:
        """The length with its unit, such as "20 cm"."""
        unit, length = joined(self.units[0]), float(np.linalg.norm(self.displacement))
        return f"{100.0 * length:.3g} cm" if unit == "m" else f"{length:.3g} {unit}"

    @property
    def bounds(self) -> str:
        """The bounds as text."""
        unit = joined(self.units[0])
        shown, factor = display_unit(unit)
        joints, away = self.units[1], []
        for each in dict.fromkeys(joints):
            most = max(d for d, u in zip(self.deviation, joints, strict=True) if u == each)
            away.append(f"{most:.2g} {each}")
        return (
            f"at up to {self.speed:.2g} {unit}/s ({self.duration:.2g} s): "
            f"|e| <= {factor * self.error:.2g} {shown}, joints within {' and '.join(away)} of "
            "their path"
        )

    def __str__(self) -> str:
        bounds = f": no speed is certified, {self.reason}" if self.reason else f" {self.bounds}"
        return f"{self.length} along {self.way}{bounds}"

    def __repr__(self) -> str:
        return f"Move({self})"


@dataclass(frozen=True, eq=False, repr=False)
class Moves:
    """Moves from one configuration.

    Attributes:
        start: The configuration, shape (nq,).
        moves: One for each displacement.
    """

    start: Array
    moves: tuple[Move, ...]

    def __str__(self) -> str:
        lines = [str(move) for move in self.moves]
        if any(not move.reason for move in self.moves):
            lines.append(_PROMISE)
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Moves({'; '.join(map(str, self.moves))})"

    @property
    def rows(self) -> list[Row]:
        """The moves as rows of a report: all in a sentence, and one for each direction."""
        speeds: dict[str, list[str]] = {}
        for move in sorted(self.moves, key=lambda each: -each.speed):
            unit = joined(move.units[0])
            speed = "at no certified speed" if move.reason else f"at {move.speed:.2g} {unit}/s"
            speeds.setdefault(speed, []).append(move.way)
        each = "; ".join(f"{', '.join(ways)} {speed}" for speed, ways in speeds.items())
        text = f"Moves of {self.moves[0].length} from rest in the middle of the region: {each}"
        if good := [move for move in self.moves if not move.reason]:
            error, joints = max(m.error for m in good), np.max([m.deviation for m in good], axis=0)
            bounds = replace(good[0], error=error, deviation=joints).bounds.split(": ")[1]
            text += f". Every robot of the box keeps {bounds}, whatever the region"
        done = {move.way: move.speed for move in self.moves}
        rows = [Row("verdict", "moves", "", {"speeds": done}, f"{text}.")]
        names = ("speed", "duration", "error", "deviation", "rate", "reason")
        for move in self.moves:
            figures = {name: getattr(move, name) for name in names}
            said = ("none", move.reason) if move.reason else ("certified", move.bounds)
            rows.append(Row("moves", move.way, said[0], figures, said[1]))
        return rows
