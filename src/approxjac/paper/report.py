"""Report of the paper's study: figures, a table of verdicts, a summary, pages."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from approxjac.errors import MissingPackageError
from approxjac.paper.experiments import ALPHA, CAMERA, LEARNING_GAIN, LENGTHS, OBJECT_MASS, Setup
from approxjac.paper.jacobian_bound import JacobianBound
from approxjac.paper.result import Result
from approxjac.robots import GravityRegressor, Robot
from approxjac.tasks import PlanarCamera
from approxjac.view import (
    new_figure,
    plot_allowed_error,
    plot_error,
    plot_parameters,
    plot_path,
    plot_torque,
    save_figure,
    save_page,
    write_index,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_result(result: Result, setup: Setup, truth: Robot) -> Figure:
    """Return one of Figures 3–8: task error, the arm's path in its plane, joint torques."""
    experiment = result.experiment
    learnt = result.theta_hat is not None
    figure, axes = new_figure(
        4 if learnt else 3,
        title=f"Figure {experiment.figure}: {experiment.title} "
        f"(K_p = {experiment.kp:g} I, K_v = {experiment.kv:g} I) — {result.verdict}",
    )
    plot_error(result.run, axes[0], title="Error of the image, coordinate by coordinate")
    plot_path(result.run, truth, q_target=setup.target, ax=axes[1])
    plot_torque(result.run, axes[2])
    if learnt:
        regressor = GravityRegressor(truth, moments="x")
        plot_parameters(result.run, regressor.names, axes[3], theta=regressor.theta)
    return figure


def draw_bound(bound: JacobianBound) -> Figure:
    """Return Figure 1: the allowed p against a, its two curves and their crossing."""
    figure, (ax,) = new_figure(size=(6.5, 4.8))
    label = "‖Jᵀ − Ĵᵀ‖ of Figure 4 at its target"
    plot_allowed_error(
        bound.lambda_2, bound.p_of_figure_4, unit="m/rad on the sensor", p_label=label, ax=ax
    )
    return figure


def summary(results: Sequence[Result], bound: JacobianBound | None, setup: Setup) -> dict[str, Any]:
    """Return the contents of `summary.json`."""
    figures: dict[str, Any] = {}
    if bound is not None:
        figures["fig1"] = {
            **dataclasses.asdict(bound),
            "condition_23_met_by_figure_4": bound.condition_23_met,
        }
    for result in results:
        experiment = result.experiment
        believed = {"lengths": experiment.lengths, "camera": _camera(experiment.camera)}
        learnt = {"L": LEARNING_GAIN, "alpha": ALPHA, "theta_hat_at_start": [0.0, 0.0]}
        entry: dict[str, Any] = {
            "title": experiment.title,
            "kp": experiment.kp,
            "kv": experiment.kv,
            "believed": believed,
            "gravity": learnt if experiment.learn_gravity else "known",
            "max_real_eigenvalue": result.local.max_real_eigenvalue,
            "error_ratio": {f"{t:g}": ratio for t, ratio in result.error_ratios.items()},
            "verdict": result.verdict,
            "reason": result.reason,
            "evidence_agrees": result.evidence_agrees,
            "paper": experiment.paper_says,
            "agrees_with_paper": result.agrees_with_paper,
        }
        if result.theta_hat is not None:
            entry["theta_hat"] = result.theta_hat.tolist()
        figures[f"fig{experiment.figure}"] = entry
    truth = {"lengths": LENGTHS, "object_mass": OBJECT_MASS, "camera": _camera(CAMERA)}
    setting = dataclasses.asdict(setup)
    return {"study": "paper", "setup": setting, "truth": truth, "figures": figures}


def _camera(camera: PlanarCamera) -> dict[str, float]:
    return {name: getattr(camera, name) for name in ("focal_length", "distance", "roll")}


def table(results: Sequence[Result], bound: JacobianBound | None) -> str:
    """Return the verdicts beside the paper's words, as text."""
    lines: list[str] = []
    if bound is not None:
        verdict = (
            "condition (23) is met there; (14) and (22), which Theorem 1 needs too, are not checked"
            if bound.condition_23_met
            else "Theorem 1 does not cover it"
        )
        lines += [
            f"Figure 1: at the target, (25) allows p < {bound.largest_allowed_p:.4f}, and (23) "
            f"allows p < {bound.allowed_p_at_a_of_figure_4:.4f} with the",
            f"gain ratio a of Figure 4, which has p = {bound.p_of_figure_4:.4f}: {verdict}.",
            "",
        ]
    if results:
        times = sorted({t for result in results for t in result.error_ratios})
        ratios = "".join(f"{f'{t:g} s':>8}" for t in times)
        lines += [
            f"{'':46}{'max Re λ':>9}   |e|/|e(0)| at",
            f"{'figure':<46}{'[1/s]':>9} {ratios}  {'verdict':<10}the paper",
        ]
    for result in results:
        experiment = result.experiment
        ratios = "".join(f"{r:8.4f}" for r in result.error_ratios.values())
        agrees = "" if result.agrees_with_paper else "  << differs"
        name = f"{experiment.figure}  {experiment.title}"
        lines.append(
            f"{name:<46}{result.local.max_real_eigenvalue:>+9.4f} {ratios}  {result.verdict:<10}"
            f"“{experiment.paper_words}”{agrees}"
        )
        if not result.agrees_with_paper or not result.evidence_agrees:
            lines.append(f"{'':3}{result.reason}")
        if result.theta_hat is not None:
            learnt = ", ".join(f"{value:.4f}" for value in result.theta_hat)
            lines.append(f"{'':3}learnt θ̂ = ({learnt}) kg m")
    return "\n".join(lines).rstrip()


def write_pages(results: Sequence[Result], out: Path) -> str:
    """Write a page of each run and an index of them; return a line that says where."""
    for result in results:
        experiment = result.experiment
        try:
            save_page(
                result.run,
                out / f"fig{experiment.figure}.html",
                f"Figure {experiment.figure}: {experiment.title} — {result.verdict}; "
                f"the paper: “{experiment.paper_words}”",
            )
        except MissingPackageError as error:
            return f"There are no pages to see in a browser: {error}"
    bound = "Figure 1: how wrong Theorem 1 lets the Jacobian be, and how wrong that of Figure 4 is"
    index = write_index(
        out,
        "The paper's two-link study: the arm as it is, and as it is believed",
        pictures={"fig1.png": bound} if (out / "fig1.png").is_file() else {},
    )
    return f"See them move: {index}"


def write_result(result: Result, setup: Setup, truth: Robot, out: Path) -> None:
    """Write figN.png, figN.svg and the trajectory figN.npz."""
    stem = out / f"fig{result.experiment.figure}"
    save_figure(draw_result(result, setup, truth), stem)
    result.run.save(stem.with_suffix(".npz"))
