"""Report of the paper's study: figures, a table of verdicts, a summary, pages."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from approxjac import law, view
from approxjac.cameras import PlanarCamera
from approxjac.errors import MissingPackageError
from approxjac.formatting import aligned, wrapped
from approxjac.paper import experiments as study
from approxjac.robots import GravityRegressor, Robot
from approxjac.tasks import FrameKinematics
from approxjac.view.style import formulas


def write_bound(bound: study.JacobianBound, out: Path) -> None:
    """Write fig1.png and fig1.svg: the allowed p against a, its two curves and their crossing."""
    alpha, p, colors = float(np.sqrt(bound.lambda_2)), bound.p_of_figure_4, view.SERIES
    a = np.linspace(0.0, 4.0 * alpha, 600)[1:]
    velocity = law.allowed_p_velocity(a, alpha, bound.lambda_2)
    position = law.allowed_p_position(a, alpha)
    figure, (ax,) = view.new_figure(size=(6.5, 4.8))
    with view.style():
        allowed = np.minimum(velocity, position)
        ax.fill_between(a, allowed, color=colors[2], alpha=0.15, label="$p$ allowed by (23)")
        ax.plot(a, velocity, color=colors[0], label=r"$2\lambda_2 / (a + \alpha)$")
        ax.plot(a, position, color=colors[1], label=r"$2 a \alpha / (a + \alpha)$")
        at = rf"$a = \lambda_2 / \alpha$ = {alpha:.4f}, $p = \sqrt{{\lambda_2}}$ = {alpha:.4f}"
        ax.plot([alpha], [alpha], "o", color=colors[6], ms=5, label=f"crossing: {at}")
        label = rf"$\|J^T - {{\hat J}}^{{\,T}}\|$ of Figure 4 at its target: {p:.4f}"
        ax.axhline(p, color=view.COLORS["neutral"], linestyle="--", label=label)
        ax.set(xlabel="$a = k_p / k_v$ [1/s]", ylabel="allowed $p$ [m/rad on the sensor]")
        ax.set(xlim=(0.0, a[-1]), ylim=(0.0, 1.25 * max(p, float(velocity.max()))))
        ax.set_title(f"Figure 1: allowed Jacobian error (α = √λ₂ = {alpha:.4f} 1/s)")
        view.legend_below(ax)
    view.save_figure(figure, out / "fig1")


def summary(
    results: Sequence[study.Reproduction], bound: study.JacobianBound | None, duration: float
) -> dict[str, Any]:
    """Return the contents of `summary.json`."""
    figures: dict[str, Any] = {}
    if bound is not None:
        met = {"condition_23_met_by_figure_4": bound.condition_23_met}
        figures["fig1"] = dataclasses.asdict(bound) | met
    learnt = {"L": study.LEARNING_GAIN, "alpha": study.ALPHA, "theta_hat_at_start": [0.0, 0.0]}
    for result in results:
        e = result.experiment
        figures[f"fig{e.figure}"] = {
            **{name: getattr(e, name) for name in ("title", "kp", "kv")},
            "believed": {"lengths": e.lengths, "camera": _camera(e.camera)},
            "gravity": learnt if e.learn_gravity else "known",
            "max_real_eigenvalue": result.local.max_real_eigenvalue,
            "error_ratio": {f"{t:g}": ratio for t, ratio in result.error_ratios.items()},
            **{name: getattr(result, name) for name in ("verdict", "reason", "evidence_agrees")},
            "paper": e.paper_says,
            "agrees_with_paper": result.agrees_with_paper,
            **({"theta_hat": result.theta_hat.tolist()} if result.theta_hat is not None else {}),
        }
    truth: dict[str, Any] = {"lengths": study.LENGTHS, "object_mass": study.OBJECT_MASS}
    truth["camera"] = _camera(study.CAMERA)
    setting = {"start": study.START, "target": study.TARGET, "duration": duration}
    return {"study": "paper", "setup": setting, "truth": truth, "figures": figures}


def _camera(camera: PlanarCamera) -> dict[str, float]:
    return {name: getattr(camera, name) for name in ("focal_length", "distance", "roll")}


def table(results: Sequence[study.Reproduction], bound: study.JacobianBound | None) -> str:
    """Return the verdicts beside the paper's words, as text; first how many are the same."""
    lines: list[str] = []
    if results:
        same = sum(result.agrees_with_paper for result in results)
        lines += [f"verdicts: {same} of {len(results)} as in the paper", ""]
    if bound is not None:
        text = (
            f"Figure 1: at the target, (25) allows p < {bound.largest_allowed_p:.4f}, and (23) "
            f"allows p < {bound.allowed_p_at_a_of_figure_4:.4f} with the gain ratio a of Figure 4, "
            f"which has p = {bound.p_of_figure_4:.4f}: Theorem 1 does not cover it."
        )
        lines += [*wrapped(text), ""]
    if results:
        times = sorted({t for result in results for t in result.error_ratios})
        lines += ["e(t) is the error of the image at t, as a share of that at the start.", ""]
        shares = [f"e({t:g} s)" for t in times]
        heads = ["figure", "max Re λ [1/s]", *shares, "verdict", "the paper"]
        lines.append(aligned([heads, *(_row(result) for result in results)]))
    for result in results:
        e = result.experiment
        if not result.agrees_with_paper or not result.evidence_agrees:
            lines += wrapped(f"Figure {e.figure}: {result.reason}")
        if result.theta_hat is not None:
            learnt = ", ".join(f"{value:.4f}" for value in result.theta_hat)
            lines.append(f"Figure {e.figure}: learnt θ̂ = ({learnt}) kg m")
    return "\n".join(lines).rstrip()


def _row(result: study.Reproduction) -> list[str]:
    e, ratios = result.experiment, [f"{r:.4f}" for r in result.error_ratios.values()]
    ends = [result.verdict, f"“{e.paper_words}”{'' if result.agrees_with_paper else ' (differs)'}"]
    return [f"{e.figure}  {e.title}", f"{result.local.max_real_eigenvalue:+.4f}", *ratios, *ends]


def write_pages(results: Sequence[study.Reproduction], out: Path) -> str:
    """Write a page of each run and an index of them; return a line that says where."""
    for result in results:
        e = result.experiment
        title = f"Figure {e.figure}: {e.title} — {result.verdict}; the paper: “{e.paper_words}”"
        try:
            view.save_page(result.run, out / f"fig{e.figure}.html", title)
        except MissingPackageError as error:
            return f"There are no pages to see in a browser: {error}"
    title = "The paper's two-link study: the arm as it is, and as it is believed"
    return f"See them move: {view.write_index(out, title)}"


def write_result(result: study.Reproduction, truth: Robot, out: Path) -> None:
    """Write figN.png and .svg (task error, path in the plane, torques) and the run, figN.npz."""
    e, learns = result.experiment, result.theta_hat is not None
    gains = f"(K_p = {e.kp:g} I, K_v = {e.kv:g} I)"
    title = formulas(f"Figure {e.figure}: {e.title} {gains} — {result.verdict}")
    figure, axes = view.new_figure(4 if learns else 3, title=title)
    view.plot_error(result.run, axes[0], title="Error of the image, coordinate by coordinate")
    target = FrameKinematics(truth, truth.tip_or(None)).position(np.array(study.TARGET))
    view.plot_path(result.run, truth, ax=axes[1], target=target)
    view.plot_torque(result.run, axes[2])
    if learns:
        regressor = GravityRegressor(truth, moments="x")
        theta = dict(zip(regressor.names, regressor.theta, strict=True))
        view.plot_parameters(result.run, ax=axes[3], truth=theta, title="Learnt gravity")
    view.save_figure(figure, out / f"fig{e.figure}")
    result.run.save(out / f"fig{e.figure}.npz")
