"""Ask each stability test about the paper's Figures 3–7, and how much camera roll it allows.

python examples/studies/certify_two_link.py --out results/certify
"""

import math
import sys
from dataclasses import replace

import numpy as np
from certify import NAMES, assess, functions
from common import head, parser, row, write

import approxjac as aj
from approxjac import law
from approxjac.paper import experiments as paper
from approxjac.stability.certificates.certificate import theorem1
from approxjac.stability.certificates.matrix_form import MatrixForm, best_weights
from approxjac.stability.loop.closed_loop import ClosedLoop

FIGURES = (3, 4, 5, 6, 7)
RADII = (0.0, 0.05, 0.2)  # half width of the regions about the target [rad]; 0 is the target alone
ALL_NAMES = {**NAMES, "local": "local, exact"}
PRECISION = 1e-3  # of a camera roll [rad]


def verdict(figure):
    """Ask the tests about a figure of the paper; return a row of the table."""
    plant, controller = paper.build(paper.EXPERIMENTS[figure])
    q = np.array(paper.TARGET)
    reports = [
        assess(
            controller,
            plant,
            aj.JointBox.around(plant.robot, q, radius),
            plant.sensor.value(q),
            20 if radius == 0.0 else 600,
        )
        for radius in RADII
    ]
    at_target = reports[0]
    return {
        "figure": figure,
        "rate": aj.local_stability(plant, controller, q).decay_rate,
        "p": at_target.theorem1.p,
        "allowed_p": at_target.theorem1.allowed_p,
        "certified": [list(functions(report)) for report in reports],
    }


def largest_roll(test, large_gains=False):
    """Return the camera roll that a test allows at the target with Figure 4's gains [deg].

    By bisection, from no roll on, of everything else nothing being wrong.

    Args:
        test: A name of `ALL_NAMES`.
        large_gains: In the limit of large gains of the same ratio k_p/k_v, where inertia plays no
            part.
    """
    low, high = 0.0, math.pi
    while high - low > PRECISION:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(test, middle, large_gains) else (low, middle)
    return math.degrees(low)


def passes(test, roll, large_gains):
    """Tell if a test allows a camera roll [rad]."""
    experiment = replace(paper.EXPERIMENTS[4], camera=replace(paper.CAMERA, roll=roll))
    plant, controller = paper.build(experiment)
    q = np.array(paper.TARGET)
    region = aj.JointBox.around(plant.robot, q, 0.0)
    loop = ClosedLoop(controller, plant, region, plant.sensor.value(q))
    at_target = loop.samples_at(np.zeros(1, dtype=int), q[None])
    setting = loop.setting
    if large_gains:
        light = {"M": 1e-9 * at_target.M, "dM": 1e-9 * at_target.dM}
        at_target = replace(at_target, **light)
    if test == "theorem1":
        first = theorem1(at_target, setting)
        if not large_gains:
            return first.p < first.allowed_p
        rest = setting.kp, setting.kv, first.lambda_1, 0.0, 0.0  # what is left of (22) is (21)
        return first.p < min(law.allowed_p(law.best_alpha(*rest, np.inf), *rest))
    if test != "local":
        return bool(best_weights(MatrixForm(at_target, setting), test).margins.min() > 0.0)
    J, J_hat, kp, kv, B = at_target.J[0], at_target.J_hat[0], setting.kp, setting.kv, setting.B
    if large_gains:  # D q̇ = −ĴᵀK_p J δq
        flow = -np.linalg.solve(law.dissipation(J_hat, kv, B), J_hat.T * kp @ J)
    else:
        flow = law.closed_loop_matrix(at_target.M[0], J, J_hat, kp, kv, B)
    return bool(np.linalg.eigvals(flow).real.max() < 0.0)


def table(figures, rolls):
    """Return the verdicts on the figures, and the rolls, as Markdown."""
    regions = [f"at the target ± {radius:g} rad" if radius else "at the target" for radius in RADII]
    lines = head("figure", "max Re λ", "p", "Theorem 1 allows", *regions)
    for entry in figures:
        certified = [
            ", ".join(ALL_NAMES[name] for name in names) or "nothing certifies"
            for names in entry["certified"]
        ]
        numbers = f"{-entry['rate']:+.4f}/s", f"{entry['p']:.4f}", f"{entry['allowed_p']:.4f}"
        lines.append(row(entry["figure"], *numbers, *certified))
    lines += ["", *head("test", "Figure 4's gains", "large gains")]
    lines += [row(ALL_NAMES[test], *(f"{roll:.1f}°" for roll in mine)) for test, mine in rolls]
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run the study; return the exit code."""
    given = parser(__doc__, "results/certify_two_link").parse_args(arguments)
    figures = [verdict(figure) for figure in (FIGURES[:2] if given.quick else FIGURES)]
    rolls = [(test, [largest_roll(test), largest_roll(test, True)]) for test in ALL_NAMES]
    summary = {"figures": figures, "largest_roll": dict(rolls)}
    write(given.out, {"certify_two_link.md": table(figures, rolls)}, summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
