"""Plot of what is learnt of an arm's kinematics, with bands of two standard deviations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from approxjac.controllers import ControllerWrapper, TrackingController
from approxjac.errors import UnknownNameError
from approxjac.simulation import Trajectory
from approxjac.validation import require
from approxjac.view.plots import over_time
from approxjac.view.style import SERIES, styled

_INSTANTS = 200
_USUAL = ("tool.", "camera.")
_SHOWN = 0.1  # share of the run after which values and bands are to be within the axes


def plot_kinematics(
    run: Trajectory,
    controller: TrackingController | ControllerWrapper,
    names: Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    truth: Mapping[str, float] | None = None,
    title: str = "What is learnt of the kinematics",
) -> Axes:
    """Draw numbers that are learnt against time, with bands of two standard deviations.

    The axes hold what is drawn after the first tenth of the run: bands begin as wide as beliefs.

    Args:
        run: A run of the controller.
        controller: What learnt in it, with its limiter if it had one.
        names: Of the numbers, such as "tool.x" or "camera.rz"; tool and camera by default.
        ax: Axes; new ones by default.
        truth: True numbers by name, drawn dashed.
        title: Of the axes.

    Raises:
        InvalidInputError: No run, or a controller that learns no kinematics.
        UnknownNameError: No such number is learnt.
    """
    require("run", run, Trajectory, "a Trajectory, such as simulate returns")
    kinds = (TrackingController, ControllerWrapper)
    wanted = "a TrackingController or PredictedMeasurement, or TorqueLimited around one"
    require("controller", controller, kinds, wanted)
    kept = np.unique(np.linspace(0, len(run.t) - 1, _INSTANTS).astype(int))
    reports = [controller.kinematics_learnt(run.state[k]) for k in kept]
    known = [row.name for row in reports[0].rows]
    chosen = [n for n in known if n.startswith(_USUAL)] if names is None else list(names)
    for name in chosen:
        if name not in known:
            raise UnknownNameError("number", name, "what is learnt", known)
    within: list[float] = []
    with styled(ax) as ax:
        for i, name in enumerate(chosen):
            j, color = known.index(name), SERIES[i % len(SERIES)]
            values = np.array([report.rows[j].value for report in reports])
            sd = np.array([report.rows[j].sd for report in reports])
            ax.plot(run.t[kept], values, color=color, label=name)
            ax.fill_between(
                run.t[kept], values - 2.0 * sd, values + 2.0 * sd, color=color, alpha=0.15, lw=0
            )
            late = kept >= _SHOWN * kept[-1]
            # a band of what is not seen is that of the belief, beside which curves lie on a line
            bands = sd * [report.rows[j].is_seen for report in reports]
            within += [*(values - 2.0 * bands)[late], *(values + 2.0 * bands)[late]]
            if truth is not None and name in truth:
                within.append(truth[name])
                ax.axhline(truth[name], color=color, linestyle="--", linewidth=0.9)
        units = dict.fromkeys(reports[0].rows[known.index(name)].unit or "–" for name in chosen)
        over_time(ax, run, ylabel=f"learnt, ± 2 sd [{' or '.join(units)}]", title=title)
        if within:
            room = 0.05 * (max(within) - min(within)) or 1e-3
            ax.set_ylim(min(within) - room, max(within) + room)
    return ax
