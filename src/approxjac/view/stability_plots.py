"""Plots of what the stability tests say."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from approxjac import law
from approxjac.validation import Array, plane_rows
from approxjac.view.style import COLORS, SERIES, formulas, styled


def plot_allowed_error(
    lambda2: float,
    p: float,
    *,
    unit: str,
    p_label: str,
    own_a: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw Figure 1: the p that (23) allows against a, its two curves and their crossing.

    Args:
        lambda2: λ₂ of (23); α is √λ₂, which allows the largest p.
        p: ‖Jᵀ − Ĵᵀ‖, drawn dashed.
        unit: Of p.
        p_label: Name of p.
        own_a: The controller's own a = k_p/k_v, marked if given [1/s]; the axis is logarithmic
            where it is far from the crossing.
        ax: Axes to draw into; new ones by default.
    """
    alpha = float(np.sqrt(lambda2))
    wide = own_a is not None and alpha > 0.0 and not 0.05 < own_a / alpha < 20.0
    right = max(4.0 * alpha, 1e-12, (3.0 if wide else 1.3) * (own_a or 0.0))
    left = min(alpha, own_a or alpha) / 10.0 if wide else 0.0
    a = np.geomspace(left, right, 600) if wide else np.linspace(left, right, 600)[1:]
    velocity = law.allowed_p_velocity(a, alpha, lambda2)
    position = law.allowed_p_position(a, alpha)
    with styled(ax, (6.5, 4.8)) as ax:
        allowed = np.minimum(velocity, position)
        ax.fill_between(a, allowed, color=SERIES[2], alpha=0.15, label="$p$ allowed by (23)")
        ax.plot(a, velocity, color=SERIES[0], label=r"$2\lambda_2 / (a + \alpha)$")
        ax.plot(a, position, color=SERIES[1], label=r"$2 a \alpha / (a + \alpha)$")
        if alpha > 0.0:
            at = rf"$a = \lambda_2 / \alpha$ = {alpha:.4f}, $p = \sqrt{{\lambda_2}}$ = {alpha:.4f}"
            label = f"crossing: {at}"
            ax.plot([alpha], [alpha], "o", color=SERIES[6], ms=5, label=label)
        ax.axhline(p, color=COLORS["neutral"], linestyle="--", label=f"{p_label}: {p:.4f}")
        if own_a is not None:
            a = np.array(own_a)
            bounds = law.allowed_p_velocity(a, alpha, lambda2), law.allowed_p_position(a, alpha)
            label = f"the controller's own $a$ = {own_a:.3g} allows $p$ = {min(bounds):.3g} with\n"
            label += r"this $\alpha$ and large gains (the report: its own $\alpha$ and gains)"
            ax.axvline(own_a, color=SERIES[3], label=label)
        ax.set(xlabel="$a = k_p / k_v$ [1/s]", ylabel=f"allowed $p$ [{unit}]", xlim=(left, right))
        ax.set(ylim=(0.0, 1.25 * max(p, float(velocity.max()))))
        crossover = rf"$\alpha = \sqrt{{\lambda_2}}$ = {alpha:.4f} 1/s"
        ax.set_title(f"Figure 1: allowed Jacobian error ({crossover})")
        if wide:
            ax.set_xscale("log")
    return ax


def plot_margins(
    positions: Array,
    margins: Array,
    plane: str = "xz",
    ax: Axes | None = None,
    *,
    title: str = "Margin over the workspace",
) -> Axes:
    """Draw the margin of each configuration at its tip, the smallest on top, crosses below zero.

    Tips are at `positions`, shape (N, 3) [m], and drawn in a plane of two world axes; margins are
    of shape (N,).
    """
    rows = plane_rows(plane)
    top = np.argsort(-margins)
    with styled(ax) as ax:
        # one that is far below zero would leave all others without colour
        reach = min(1.0, max(0.05, float(np.abs(margins[np.isfinite(margins)]).max(initial=0.0))))
        for passes, marker, name in ((True, "o", "holds in"), (False, "x", "fails in")):
            chosen = top[(margins[top] > 0.0) == passes]
            if len(chosen) == 0:
                continue
            dots = ax.scatter(
                positions[chosen, rows[0]], positions[chosen, rows[1]], marker=marker,
                s=9 if passes else 14, linewidths=0.0 if passes else 1.2,
                c=np.clip(margins[chosen], -reach, reach), cmap="RdYlBu", vmin=-reach, vmax=reach,
            )  # fmt: skip
            label = f"{name} {len(chosen)} of {len(margins)} configurations"
            ax.plot([], [], marker, ms=4, color="0.4", label=label)
        worst = positions[margins.argmin(), rows]
        ax.plot(*worst, "s", mfc="none", mec=SERIES[6], ms=9, mew=1.5,
                label=f"worst: {margins.min():.3g}")  # fmt: skip
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(xlabel=f"{plane[0]} [m]", ylabel=f"{plane[1]} [m]", title=title)
        ax.figure.colorbar(dots, ax=ax, label="margin [–]", shrink=0.8)
    return ax


def plot_shares(
    x: Array,
    y: Array,
    shares: Array,
    *,
    labels: tuple[str, str],
    own: tuple[float, float] | None = None,
    own_name: str = "as given",
    ax: Axes | None = None,
    title: str = "Share of runs that converge",
) -> Axes:
    """Draw the share of runs that converge over two parameters, or an end of its interval.

    Args:
        x: Values of the first parameter, shape (N_x,).
        y: Values of the second, shape (N_y,).
        shares: Shape (N_y, N_x), 0 to 1; NaN is left grey.
        labels: Of the axes.
        own: Where the controller and its errors are, or what it believes.
        own_name: What that is called.
        ax: Axes to draw into; new ones by default.
        title: Of the axes.
    """
    with styled(ax, (5.6, 4.6)) as ax:
        ax.set_facecolor("0.85")
        shown = ax.pcolormesh(
            x, y, np.ma.masked_invalid(shares), cmap="RdYlBu", vmin=0.0, vmax=1.0,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        ax.figure.colorbar(shown, ax=ax, label="share that converges [–]", shrink=0.8)
        if own is not None:
            ax.plot(*own, "*", color=SERIES[6], mec="white", ms=14, label=own_name)
        _scale(ax, x, y)
        ax.set(xlabel=formulas(labels[0]), ylabel=formulas(labels[1]), title=title)
        ax.grid(visible=False)
    return ax


def _scale(ax: Axes, x: Array, y: Array) -> None:
    """Take logarithmic axes where values go over decades."""
    for values, set_scale in ((x, ax.set_xscale), (y, ax.set_yscale)):
        if values[0] > 0.0 and values[-1] / values[0] > 20.0:
            set_scale("log")
