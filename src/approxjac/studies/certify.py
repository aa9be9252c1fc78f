"""Whether the stability tests tell the truth: random closed loops, tested first and then run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac import law
from approxjac.errors import SimulationError
from approxjac.simulation import Trajectory, simulate
from approxjac.stability import StabilityReport, local_stability, stability_report
from approxjac.stability.matrix_form import MatrixForm, Setting, Weights
from approxjac.stability.samples import Sampler, Scenarios
from approxjac.studies.certify_cases import Case, Loop, build
from approxjac.studies.processes import run_in_processes
from approxjac.validation import Array

TESTS = ("theorem1", "paper", "free", "wide")
"""Test 1 and the families of test 2, all of which certify a region."""
POSTURES = 500
_FEW = 120
DAMPINGS = ((1.0, 1.0), (1.0, 4.0), (4.0, 4.0), (4.0, 16.0), (1.0, 0.25), (4.0, 1.0))
"""Factors of K_v and B_c that are tried in turn where damping may be chosen."""
_TIME_CONSTANTS, _LONGEST, _PIECES = 12.0, 200.0, 3
_UNSTABLE_RUN = 10.0  # [s]
_CONVERGED = 1e-3  # of the error at the start
_RECORDS = 300
_RISE = 1e-7  # of V, relative to its largest value, that is round-off
_PERTURBATION = 1e-5  # [rad]
_UNDECIDED = 1e-3  # max Re λ nearer to zero is not judged [1/s]


class Motion(NamedTuple):
    """A run in pieces, each going on where the last one ended."""

    pieces: tuple[Trajectory, ...]
    converged: bool
    stayed: bool


class Outcome(NamedTuple):
    """What the tests said of a case, and what happened.

    Attributes:
        case: The case.
        n_v: Joints.
        m: Task coordinates.
        error_size: Of `Loop`.
        radius: Of `Loop` [rad].
        jacobian_error: p over the smallest singular value of Ĵ in the region.
        singular: Whether Ĵ loses rank somewhere in the region, so that nothing certifies it.
        wrong_way: Share of the region's postures that no large gains make stable targets: D⁻¹ĴᵀK_p
            drives some error there away.
        added_damping: Whether B_c > 0.
        saturated: Whether s(e) bends.
        margins: Margin of each of `TESTS`, by name.
        certified: Whether it certifies.
        stable: Verdict of the local test at the target's posture.
        rate: −max Re λ there [1/s].
        converged: Whether the error died out.
        stayed: Whether the motion stayed in the region.
        rises: Largest rise of V within the region, relative to its largest value, by test that
            certifies.
        unseen: Least margin of postures of the motion within the region, by test that certifies.
        near_rate: Rate at which a small perturbation of the target died out [1/s]; NaN where it
            is not judged.
        damping: First of `DAMPINGS` with which test 2 certifies and the motion converges; None if
            none does, or the case does not converge.
    """

    case: Case
    n_v: int
    m: int
    error_size: float
    radius: float
    jacobian_error: float
    singular: bool
    wrong_way: float
    added_damping: bool
    saturated: bool
    margins: Mapping[str, float]
    certified: Mapping[str, bool]
    stable: bool
    rate: float
    converged: bool
    stayed: bool
    rises: Mapping[str, float]
    unseen: Mapping[str, float]
    near_rate: float
    damping: tuple[float, float] | None

    @property
    def counterexamples(self) -> list[str]:
        """What contradicts a test, in words."""
        found = [
            f"{test} certifies, V rises by {rise:.2g} of it within the region"
            for test, rise in self.rises.items()
            if rise > _RISE
        ]
        if self.stayed and not self.converged:
            found += [
                f"{test} certifies, the motion stays in the region and does not converge"
                for test, certified in self.certified.items()
                if certified
            ]
        if not math.isnan(self.near_rate) and (self.near_rate > 0.0) != self.stable:
            found.append(
                f"the local test says {self.rate:+.3g}/s, a small error dies out at "
                f"{self.near_rate:+.3g}/s"
            )
        return found


def run_case(case: Case) -> Outcome:
    """Test a case, run it, and hold one against the other."""
    loop = build(case)
    report = assess(loop)
    local = local_stability(loop.plant, loop.controller, loop.q_target)
    motion = move(loop, local.decay_rate)
    chosen = functions(report)
    rises, unseen = watch(loop, report, motion, chosen)
    near = near_rate(loop, local.decay_rate) if abs(local.decay_rate) > _UNDECIDED else math.nan
    first, task = report.theorem1, loop.controller.task
    weakest = np.linalg.svd(report.scenarios.J_hat, compute_uv=False)[:, -1].min()
    return Outcome(
        case,
        task.robot.nv,
        task.m,
        loop.error_size,
        loop.radius,
        first.p / float(weakest),
        report.singular_q is not None,
        wrong_way(report),
        bool(loop.controller.diagonals.damping.any()),
        not isinstance(loop.controller.saturation, law.Linear),
        {"theorem1": first.margin} | {str(f): t.margin for f, t in report.matrix.items()},
        {name: name in chosen for name in TESTS},
        local.stable,
        local.decay_rate,
        motion.converged,
        motion.stayed,
        rises,
        unseen,
        near,
        choose_damping(loop, report) if motion.converged else None,
    )


def run(
    cases: Sequence[Case],
    jobs: int | None = None,
    progress: Callable[[], None] | None = None,
) -> list[Outcome]:
    """Run cases in several processes, and return their outcomes in the order of the cases."""
    return run_in_processes(run_case, cases, jobs, progress)


def assess(loop: Loop, postures: int = POSTURES) -> StabilityReport:
    """What the tests say before anything moves."""
    return stability_report(
        loop.controller, loop.plant, loop.region, target=loop.target, postures=postures
    )


def functions(report: StabilityReport) -> dict[str, Weights]:
    """The Lyapunov functions with which a report certifies, by test."""
    first = report.theorem1
    found: dict[str, Weights] = {}
    if report.singular_q is not None:
        return found
    if first.holds:
        kp, kv = first.setting.kp, first.setting.kv
        m = len(kp)
        found["theorem1"] = Weights(
            first.alpha * np.eye(m), np.zeros((m, m)), kp + first.alpha * kv
        )
    found.update({str(f): t.weights for f, t in report.matrix.items() if t.certified})
    return found


def move(loop: Loop, rate: float) -> Motion:
    """Run a loop, at least as long as its slowest mode needs and until it converges.

    The first piece is short, so that fast transients are recorded too.

    Args:
        loop: The loop.
        rate: At which an error near the target dies out [1/s]; ≤ 0 where it does not, and then
            the loop gets one short run only.
    """
    duration, pieces_at_most = _UNSTABLE_RUN, 1
    if rate > 0.0:
        duration, pieces_at_most = min(_TIME_CONSTANTS / rate, _LONGEST), _PIECES
    lengths = [duration / 30.0, *(duration * 2.0**k for k in range(pieces_at_most))]
    pieces: list[Trajectory] = []
    q, v = loop.q0, np.zeros(loop.plant.robot.nv)
    for length in lengths:
        try:
            piece = simulate(
                loop.plant, loop.controller, loop.target, q, length, v0=v, dt=None,
                record_every=length / _RECORDS,
            )  # fmt: skip
        except SimulationError:
            return Motion(tuple(pieces), False, False)
        pieces.append(piece)
        q, v = piece.q[-1], piece.v[-1]
        if len(pieces) > 1 and _has_converged(piece, pieces[0].error_norm[0]):
            stayed = all(loop.region.contains(q) for run in pieces for q in run.q)
            return Motion(tuple(pieces), True, stayed)
    stayed = all(loop.region.contains(q) for run in pieces for q in run.q)
    return Motion(tuple(pieces), False, stayed)


def _has_converged(piece: Trajectory, start_error: float) -> bool:
    last = piece.error_norm[-_RECORDS // 5 :]
    return bool(last.max() <= _CONVERGED * start_error)


def watch(
    loop: Loop, report: StabilityReport, motion: Motion, chosen: Mapping[str, Weights]
) -> tuple[dict[str, float], dict[str, float]]:
    """Largest rise of each V and least margin of the postures, both while in the region."""
    rises, unseen = dict.fromkeys(chosen, 0.0), dict.fromkeys(chosen, math.inf)
    if not chosen:
        return rises, unseen
    sampler = Sampler(loop.controller, [loop.plant], loop.region, loop.target)
    setting = report.theorem1.setting
    largest = dict.fromkeys(chosen, 0.0)
    steepest = dict.fromkeys(chosen, 0.0)
    for piece in motion.pieces:
        inside = np.array([loop.region.contains(q) for q in piece.q])
        if not inside.any():
            continue
        kept = np.flatnonzero(inside)
        seen = sampler.at(np.zeros(len(kept), dtype=int), piece.q[kept])
        form = MatrixForm(seen, setting)
        follow = np.diff(kept) == 1
        for name, weights in chosen.items():
            V = lyapunov_values(loop, seen, setting, weights, piece, kept)
            largest[name] = max(largest[name], float(V.max()))
            steepest[name] = max(steepest[name], float(np.diff(V)[follow].max(initial=0.0)))
            unseen[name] = min(unseen[name], float(form.margins(weights).min()))
    rises = {name: steepest[name] / max(largest[name], 1e-300) for name in chosen}
    return rises, unseen


def lyapunov_values(
    loop: Loop,
    seen: Scenarios,
    setting: Setting,
    weights: Weights,
    piece: Trajectory,
    kept: NDArray[np.intp],
) -> Array:
    """V = ½q̇ᵀMq̇ + q̇ᵀMGs + Σ wᵢSᵢ at the recorded instants `kept`, shape (len(kept),)."""
    v, e = piece.v[kept], piece.error[kept]
    D = law.dissipation(seen.J_hat, setting.kv, setting.B)
    G = (
        law.cross_weight_pinv(seen.J_hat, seen.dJ_hat)[0] @ weights.A1
        + law.cross_weight_damped(D, seen.J_hat, seen.dJ_hat, setting.kv)[0] @ weights.A2
    )
    momentum = np.einsum("kij,kj->ki", seen.M, v)
    Gs = np.einsum("kij,kj->ki", G, seen.s)
    potential: Array = loop.controller.saturation.S(e) @ weights.w
    V: Array = (momentum * (0.5 * v + Gs)).sum(axis=1) + potential
    return V


def near_rate(loop: Loop, rate: float) -> float:
    """Rate at which a small random perturbation of the target dies out, simulated [1/s].

    From what is left of the energy ½q̇ᵀMq̇ + ½eᵀK_p e after three and after six of the times that
    the local test tells. Windows of a time hold the swings of modes that oscillate.
    """
    rng = np.random.default_rng(0)
    plant, n = loop.plant, loop.plant.robot.nv
    start = pin.integrate(plant.robot.model, loop.q_target, _PERTURBATION * rng.standard_normal(n))
    time = 3.0 / abs(rate)
    run = simulate(
        plant, loop.controller, loop.target, start, 2.0 * time, record_every=time / 400.0,
        dt=None, atol=1e-12, rtol=1e-7,
    )  # fmt: skip
    kp = loop.controller.diagonals.kp
    M = plant.dynamics.M(loop.q_target)
    energy = np.einsum("ki,ij,kj->k", run.v, M, run.v) + (run.error**2) @ kp
    early, late = energy[300:400].max(), energy[700:800].max()
    return 0.5 * math.log(early / late) / time


def wrong_way(report: StabilityReport) -> float:
    """Share of the postures where J D⁻¹ĴᵀK_p, by which slow errors die out, has unstable modes."""
    at, setting = report.scenarios, report.theorem1.setting
    D = law.dissipation(at.J_hat, setting.kv, setting.B)
    flow = at.J @ np.linalg.solve(D, np.swapaxes(at.J_hat, -1, -2)) * setting.kp
    return float((np.linalg.eigvals(flow).real.min(axis=-1) <= 0.0).mean())


def choose_damping(loop: Loop, report: StabilityReport) -> tuple[float, float] | None:
    """The first of `DAMPINGS` that test 2 certifies and with which the motion converges.

    Args:
        loop: A loop that converges.
        report: What the tests say of it, which is the first of `DAMPINGS`.
    """
    if report.singular_q is not None:  # whatever the damping
        return None
    if _certified_by_test_2(report):
        return DAMPINGS[0]
    for factors in DAMPINGS[1:]:
        damped = loop.with_damping(*factors)
        # most fail, and few postures tell
        if _certified_by_test_2(assess(damped, _FEW)) and _certified_by_test_2(assess(damped)):
            local = local_stability(damped.plant, damped.controller, damped.q_target)
            if move(damped, local.decay_rate).converged:
                return factors
    return None


def _certified_by_test_2(report: StabilityReport) -> bool:
    return not {"paper", "free", "wide"}.isdisjoint(functions(report))
