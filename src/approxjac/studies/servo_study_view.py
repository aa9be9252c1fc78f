"""Pictures of `approxjac servo-study`: what noise does to each law, and the map of roll."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from approxjac.studies.servo_map import LOOPS, Cell, Loop
from approxjac.studies.servo_study import LAWS, ONE_POINT, Outcome
from approxjac.studies.servo_study_report import Row, rows
from approxjac.validation import Array
from approxjac.view import SERIES, new_figure, style
from approxjac.view.style import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = "osv^D<>P"
_LEAST = 0.01  # error below which no picture need tell more [px]
_SMOOTH = 1e-3  # the same of the torque's roughness [N m]
_WORTH = {"converges": 1.0, "undecided": 0.5, "diverges": 0.0}
_HUES = (*SERIES, COLORS["neutral"])  # one for each law
_TITLES: dict[Loop, str] = {
    "ideal": "ideal camera, continuous control",
    "late": "camera of 30 Hz, late and noisy",
}


def draw_noise(outcomes: Sequence[Outcome]) -> Figure:
    """Convergence, error, roughness and peak of the torque against noise, law by law."""
    mine = [row for row in rows(outcomes) if row.scene == ONE_POINT]
    noises = sorted({row.noise for row in mine})
    panels: list[tuple[str, Callable[[Row], float], bool]] = [
        ("converged to within the noise [%]", lambda r: 100.0 * r.converged / r.runs, False),
        (f"error at the end, median [px], at least {_LEAST:g}",
         lambda r: max(_LEAST, r.error), True),
        (f"torque roughness at the end, median [N m], at least {_SMOOTH:g}",
         lambda r: r.roughness if math.isnan(r.roughness) else max(_SMOOTH, r.roughness), True),
        ("peak torque / its limit, median", lambda r: r.peak_torque, True),
    ]  # fmt: skip
    figure, axes = new_figure(2, 2, size=(9.4, 8.2), title=ONE_POINT)
    with style():
        for ax, (label, value, wide) in zip(axes, panels, strict=True):
            for k, law in enumerate(LAWS):
                series = [row for row in mine if row.law == law]
                _lines(ax, law, k, noises, [(row.noise, value(row)) for row in series])
            ax.set_xticks(range(len(noises)), [f"{noise:g}" for noise in noises])
            ax.set(xlabel="noise of the image [px]", ylabel=label)
            if wide:
                ax.set_yscale("log")
        axes[3].set_yscale("log", base=2)
        axes[3].yaxis.set_major_formatter("{x:g}")
        axes[3].axhline(1.0, color=COLORS["neutral"], linewidth=1.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _lines(
    ax: Axes, law: str, k: int, noises: Sequence[float], points: Sequence[tuple[float, float]]
) -> None:
    known = LAWS[law]
    foreign = known.gains is not None or known.damping is not None
    # beside each other, or equal ones would hide each other
    aside = 0.03 * (k - 0.5 * (len(LAWS) - 1))
    shown = [(noises.index(noise) + aside, y) for noise, y in points if math.isfinite(y)]
    if not shown:
        return
    ax.plot(
        *zip(*shown, strict=True), _MARKERS[k], linestyle="--" if foreign else "-", ms=5,
        color=_HUES[k % len(_HUES)], label=law,
    )  # fmt: skip


def draw_map(cells: Sequence[Cell]) -> Figure:
    """Share of the goals that simulation converges to, and the local test's boundary for each."""
    loops = [loop for loop in LOOPS if any(cell.loop == loop for cell in cells)]
    figure, axes = new_figure(len(loops), size=(4.9 * len(loops), 4.6))
    rolls, ratios = (np.array(sorted({cell[i] for cell in cells})) for i in (1, 2))
    goals = sorted({cell.goal for cell in cells})
    with style():
        for ax, loop in zip(axes, loops, strict=True):
            mine = [cell for cell in cells if cell.loop == loop]
            share = _grid(mine, rolls, ratios, lambda cell: _WORTH[cell.verdict])
            heights = np.log2(ratios)
            shown = ax.pcolormesh(
                rolls, heights, share, cmap="RdYlBu", vmin=-0.25, vmax=1.25, shading="nearest",
                rasterized=True,
            )  # fmt: skip
            _boundaries(ax, mine, rolls, ratios, goals)
            differing = [c for c in mine if c.predicted != c.verdict]
            ax.plot(
                [c.roll for c in differing], [math.log2(c.ratio) for c in differing], "x",
                color=SERIES[6], ms=7, mew=1.6, label="test and simulation differ",
            )  # fmt: skip
            ax.set_yticks(heights, [f"{ratio:g}" for ratio in ratios])
            ax.set(xlabel="error of the believed roll [°]", ylabel="a = k_p / k_v [1/s]",
                   title=_TITLES[loop])  # fmt: skip
            ax.grid(visible=False)
        bar = figure.colorbar(
            shown, ax=axes, label="share of goals that simulation converges to (undecided: half)"
        )
        bar.ax.set_ylim(0.0, 1.0)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _boundaries(
    ax: Axes, cells: Sequence[Cell], rolls: Array, ratios: Array, goals: Sequence[int]
) -> None:
    """Where the local test's decay rate is zero, a line for each goal."""
    label = "boundary that the local test predicts, goal by goal"
    ax.plot([], [], color=SERIES[6], linewidth=1.4, label=label)
    if len(rolls) < 2 or len(ratios) < 2:
        return  # no contour runs there
    for goal in goals:
        rate = _grid([c for c in cells if c.goal == goal], rolls, ratios, lambda c: c.decay_rate)
        if rate.min() < 0.0 < rate.max():
            ax.contour(rolls, np.log2(ratios), rate, levels=[0.0], colors=[SERIES[6]],
                       linewidths=1.4)  # fmt: skip


def _grid(
    cells: Sequence[Cell], rolls: Array, ratios: Array, value: Callable[[Cell], float]
) -> Array:
    """Mean of a value over the cells at each place, shape (ratios, rolls)."""
    found = [[_mean(cells, float(roll), float(ratio), value) for roll in rolls] for ratio in ratios]
    return np.array(found)


def _mean(
    cells: Sequence[Cell], roll: float, ratio: float, value: Callable[[Cell], float]
) -> float:
    """Mean of a value over the cells with a roll and a gain ratio; NaN of none."""
    values = [value(cell) for cell in cells if (cell.roll, cell.ratio) == (roll, ratio)]
    return float(np.mean(values)) if values else math.nan
