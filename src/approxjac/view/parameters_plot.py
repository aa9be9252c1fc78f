"""Plot of what a controller learns, with bands of two standard deviations where they are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.simulation import Trajectory
from approxjac.validation import require
from approxjac.view.plots import over_time
from approxjac.view.style import COLORS, SERIES, styled

_INSTANTS = 200
_USUAL = ("tool.", "camera.")
_SHOWN = 0.1  # share of the run after which values and bands are to be within the axes
_SEEN = 0.7  # of a first standard deviation: below it half of the variance was resolved


def plot_parameters(
    run: Trajectory,
    names: Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    truth: Mapping[str, float] | None = None,
    title: str = "What is learnt",
) -> Axes:
    """Draw numbers that are learnt against time, ± two standard deviations where they are known.

    Where there are bands, the axes hold what is drawn after the first tenth of the run: bands
    begin as wide as beliefs.

    Args:
        run: A run of a controller that learns.
        names: Of the numbers, such as "tool.x" or "panda_joint1.m", of `run.parameters`; tool and
            camera by default where they are learnt, else all.
        ax: Axes; new ones by default.
        truth: True numbers by name, drawn dashed.
        title: Of the axes.

    Raises:
        InvalidInputError: No run, or one in which nothing was learnt.
        UnknownNameError: No such number is learnt.
    """
    require("run", run, Trajectory, "a Trajectory, such as simulate returns")
    known = list(run.parameters)
    if not known:
        raise InvalidInputError(
            f"run must be one in which something was learnt, got {run!r}", given=run
        )
    usual = [name for name in known if name.startswith(_USUAL)] or known
    chosen = usual if names is None else list(names)
    for name in chosen:
        if name not in known:
            raise UnknownNameError("number", name, "what is learnt", known)
    kept = np.unique(np.linspace(0, len(run.t) - 1, _INSTANTS).astype(int))
    deviations = np.array([run.learnt_sd(k) for k in kept])
    late = kept >= _SHOWN * kept[-1]
    within: list[float] = []
    with styled(ax) as ax:
        for i, name in enumerate(chosen):
            j, color = known.index(name), SERIES[i % len(SERIES)]
            values, sd = run.learnt[kept, j], deviations[:, j]
            if np.isnan(sd).all():
                ax.plot(run.t, run.learnt[:, j], color=color, label=name)
            else:
                ax.plot(run.t[kept], values, color=color, label=name)
                low, high = values - 2.0 * sd, values + 2.0 * sd
                ax.fill_between(run.t[kept], low, high, color=color, alpha=0.15, lw=0)
                # a band of what is not seen is that of the belief, beside which curves are flat
                bands = 2.0 * sd * (sd <= _SEEN * sd[0])
                within += [*(values - bands)[late], *(values + bands)[late]]
            if truth is not None and name in truth:
                within.append(truth[name])
                ax.axhline(truth[name], color=color, linestyle="--", linewidth=0.9)
        if truth is not None:
            ax.plot([], [], "--", color=COLORS["neutral"], linewidth=0.9, label="true values")
        units = dict.fromkeys(run.parameters[name] or "–" for name in chosen)
        shown = ", ± 2 sd" if np.isfinite(deviations).any() else ""
        over_time(ax, run, ylabel=f"learnt{shown} [{' or '.join(units)}]", title=title)
        if np.isfinite(deviations).any() and within:
            room = 0.05 * (max(within) - min(within)) or 1e-3
            ax.set_ylim(min(within) - room, max(within) + room)
    return ax
