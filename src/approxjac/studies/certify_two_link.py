"""What each stability test says of the paper's Figures 3–7, and how much camera roll it allows."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from approxjac import law, paper
from approxjac.stability import JointBox, stability_report
from approxjac.stability.closed_loop import setting_of
from approxjac.stability.matrix_form import FAMILIES, MatrixForm, Setting, best_weights
from approxjac.stability.samples import Sampler, Scenarios
from approxjac.stability.theorem1 import theorem1

FIGURES = (3, 4, 5, 6, 7)
RADII = (0.0, 0.05, 0.2)
"""Half width of the regions about the target [rad]; 0 is the target alone."""
TESTS = ("theorem1", *FAMILIES, "local")
_PRECISION = 1e-3  # [rad]


class Verdict(NamedTuple):
    """What the tests say of a figure.

    Attributes:
        figure: Its number.
        rate: −max Re λ at the target [1/s].
        p: Largest ‖Jᵀ − Ĵᵀ‖ at the target.
        allowed_p: The p that Theorem 1 allows there.
        certified: Tests that certify, by radius of the region [rad].
    """

    figure: int
    rate: float
    p: float
    allowed_p: float
    certified: Mapping[float, tuple[str, ...]]


def verdict(figure: int, radii: Sequence[float] = RADII) -> Verdict:
    """Ask the tests about a figure of the paper."""
    setup = paper.Setup()
    plant, controller = paper.build(paper.EXPERIMENTS[figure], setup)
    q = np.array(setup.target)
    certified, first, rate = {}, None, math.nan
    for radius in radii:
        report = stability_report(
            controller,
            plant,
            JointBox.around(plant.robot, q, radius),
            target=plant.sensor.value(q),
            postures=20 if radius == 0.0 else 600,
        )
        passed = ["theorem1"] if report.theorem1.holds else []
        passed += [str(family) for family, test in report.matrix.items() if test.certified]
        certified[radius] = tuple(passed) if report.singular_q is None else ()
        if first is None:
            first, rate = report.theorem1, float(report.local.decay_rates.min())
    assert first is not None
    return Verdict(figure, rate, first.p, first.allowed_p, certified)


def largest_roll(test: str, large_gains: bool = False) -> float:
    """The camera roll that a test allows at the target with Figure 4's gains [rad].

    By bisection, from no roll on, of everything else nothing being wrong.

    Args:
        test: One of `TESTS`.
        large_gains: In the limit of large gains of the same ratio k_p/k_v, where inertia plays no
            part; else with Figure 4's gains.
    """
    low, high = 0.0, math.pi
    while high - low > _PRECISION:
        middle = 0.5 * (low + high)
        if _passes(test, middle, large_gains):
            low = middle
        else:
            high = middle
    return low


def _passes(test: str, roll: float, large_gains: bool) -> bool:
    experiment = replace(paper.EXPERIMENTS[4], camera=replace(paper.CAMERA, roll=roll))
    setup = paper.Setup()
    plant, controller = paper.build(experiment, setup)
    q = np.array(setup.target)
    sampler = Sampler(
        controller, [plant], JointBox.around(plant.robot, q, 0.0), plant.sensor.value(q)
    )
    at_target = sampler.at(np.zeros(1, dtype=int), q[None])
    setting = replace(setting_of(controller, plant), large_gains=large_gains)
    if test == "theorem1":
        first = theorem1(at_target, setting)
        return first.p < (first.allowed_p_large_gains if large_gains else first.allowed_p)
    if test == "local":
        return _is_stable(at_target, setting)
    form = MatrixForm(at_target, setting)
    return bool(best_weights(form, test).margins.min() > 0.0)  # type: ignore[arg-type]


def _is_stable(at_target: Scenarios, setting: Setting) -> bool:
    J, J_hat, kp, kv, B = at_target.J[0], at_target.J_hat[0], setting.kp, setting.kv, setting.B
    if setting.large_gains:  # D q̇ = −ĴᵀK_p J δq
        flow = -np.linalg.solve(law.dissipation(J_hat, kv, B), J_hat.T * kp @ J)
    else:
        flow = law.closed_loop_matrix(at_target.M[0], J, J_hat, kp, kv, B)
    return bool(np.linalg.eigvals(flow).real.max() < 0.0)


def run(progress: Callable[[], None] | None = None) -> dict[str, Any]:
    """All verdicts and rolls [deg], as they go into summary.json."""
    found: dict[str, Any] = {"figures": [], "largest_roll": {}}
    for figure in FIGURES:
        found["figures"].append(verdict(figure)._asdict())
    for test in TESTS:
        found["largest_roll"][test] = {
            "figure_4": math.degrees(largest_roll(test)),
            "large_gains": math.degrees(largest_roll(test, large_gains=True)),
        }
    return found
