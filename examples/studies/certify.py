"""Hold the stability tests against simulations of random closed loops, and count what they miss.

A case is a random closed loop as eq. (9) has it, without gravity. It is tested first and run then.
A test that certifies must not be contradicted: its own Lyapunov function may not rise within the
region, and a motion that stays there has to converge. docs/studies/conservatism.md says what comes
out.

    python examples/studies/certify.py --out results/certify

Exit code 1 means that a counterexample was found.
"""

import math
import sys
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from common import head, parser, row, run_all, write
from random_loops import Case, build, cases, damped

import approxjac as aj
from approxjac import law
from approxjac.stability.certificates.certificate import MatrixTest, Theorem1, theorem1
from approxjac.stability.certificates.matrix_form import FAMILIES, MatrixForm, Weights
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Samples
from approxjac.stability.search.worst import searched_test

NAMES = {"theorem1": "Theorem 1", "free": "free potential", "full": "coupled"}
TESTS = tuple(NAMES)  # Theorem 1 and the two families of the matrix form ("test 2")
DAMPINGS = ((1.0, 1.0), (1.0, 4.0), (4.0, 4.0), (4.0, 16.0), (1.0, 0.25), (4.0, 1.0))
CONFIGURATIONS, FEW = 500, 120  # that a test looks at
TIME_CONSTANTS, LONGEST, PIECES, UNSTABLE_RUN = 12.0, 200.0, 3, 10.0  # of a run; [s]
RECORDS = 300
CONVERGED = 1e-3  # of the error at the start
RISE = 1e-7  # of V, relative to its largest value, that is round-off
UNDECIDED = 1e-3  # max Re λ nearer to zero is not judged [1/s]
BINS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, math.inf)  # p over σ_min(Ĵ)


class Assessment(NamedTuple):
    """What the tests in continuous time say before anything moves."""

    samples: Samples
    theorem1: Theorem1
    test: MatrixTest  # of one function, in which a search found no case that fails
    singular_q: np.ndarray | None  # where Ĵ loses rank


class Outcome(NamedTuple):
    """What the tests said of a case, and what happened."""

    case: Case
    radius: float
    jacobian_error: float  # p over the smallest singular value of Ĵ in the region
    singular: bool  # Ĵ loses rank in the region, so that nothing certifies it
    wrong_way: float  # share of the configurations that no large gains make stable targets
    certified: dict  # by test
    stable: bool  # verdict of the local test at the target
    rate: float  # −max Re λ there [1/s]
    converged: bool
    stayed: bool  # in the region
    rises: dict  # largest rise of V in the region over its largest value, by test that certifies
    unseen: dict  # least margin on the way, by test that certifies
    near_rate: float  # at which a small perturbation died out [1/s]; NaN where not judged
    damping: tuple | None  # first of DAMPINGS that test 2 certifies and that converges

    def counterexamples(self):
        """Return what contradicts a test, in words."""
        found = [
            f"{test} certifies, V rises by {rise:.2g} of it within the region"
            for test, rise in self.rises.items()
            if rise > RISE
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
        name = f"{self.case.kind}, seed {self.case.seed}, case {self.case.number}"
        return [f"{name}: {text}" for text in found]


# -- tests and motions ----------------------------------------------------------------------------


def run_case(case):
    """Test a case, run it, and hold one against the other."""
    loop = build(case)
    report = assess(loop.controller, loop.plant, loop.region, loop.target)
    local = aj.local_stability(loop.plant, loop.controller, loop.q_target)
    pieces, converged, stayed = move(loop, local.decay_rate)
    chosen = functions(report)
    rises, unseen = watch(loop, report, pieces, chosen)
    judged = abs(local.decay_rate) > UNDECIDED
    weakest = np.linalg.svd(report.samples.J_hat, compute_uv=False)[:, -1].min()
    return Outcome(
        case,
        loop.radius,
        report.theorem1.p / float(weakest),
        report.singular_q is not None,
        wrong_way(report),
        {name: name in chosen for name in TESTS},
        local.stable,
        local.decay_rate,
        converged,
        stayed,
        rises,
        unseen,
        near_rate(loop, local.decay_rate) if judged else math.nan,
        choose_damping(loop, report) if converged else None,
    )


def assess(controller, plant, region, target, configurations=CONFIGURATIONS):
    """Return what the tests say before anything moves."""
    loop, rng = ClosedLoop(controller, plant, region, target), np.random.default_rng(0)
    samples, fresh = (loop.draw(configurations // 2, rng) for _ in range(2))
    test = searched_test(loop, None, samples, rng).checked_on(fresh)
    everywhere = test.form.samples.join(fresh)
    return Assessment(
        everywhere, theorem1(everywhere, loop.setting), test, loop.singular_configuration(samples)
    )


def functions(report):
    """Return the Lyapunov functions with which a report certifies, by test."""
    first, found = report.theorem1, {}
    if report.singular_q is not None:
        return found
    if first.holds:
        kp, kv = first.setting.kp, first.setting.kv
        m = len(kp)
        alpha = first.alpha
        found["theorem1"] = Weights(alpha * np.eye(m), np.zeros((m, m)), kp + alpha * kv)
    if report.test.certified:  # and so do the families that hold its own
        families = FAMILIES[FAMILIES.index(report.test.family) :]
        found |= dict.fromkeys(map(str, families), report.test.weights)
    return found


def move(loop, rate):
    """Run a loop in pieces, as long as its slowest mode needs; return them, converged, stayed.

    The first piece is short, so that fast transients are recorded too. Where the local test says
    that an error grows (rate ≤ 0) the loop gets one short run only.
    """
    duration, at_most = UNSTABLE_RUN, 1
    if rate > 0.0:
        duration, at_most = min(TIME_CONSTANTS / rate, LONGEST), PIECES
    pieces, converged = [], False
    q, v = loop.q0, np.zeros(loop.plant.robot.nv)
    for length in (duration / 30.0, *(duration * 2.0**k for k in range(at_most))):
        try:
            piece = aj.simulate(
                loop.plant,
                loop.controller,
                loop.target,
                aj.simulation.InitialState(q, v0=v),
                length,
                dt=None,
                record_every=length / RECORDS,
            )
        except aj.errors.SimulationError:
            return pieces, False, False
        pieces.append(piece)
        q, v = piece.q[-1], piece.v[-1]
        last = piece.error_norm[-RECORDS // 5 :].max()
        converged = len(pieces) > 1 and bool(last <= CONVERGED * pieces[0].error_norm[0])
        if converged:
            break
    return pieces, converged, all(loop.region.contains(q) for piece in pieces for q in piece.q)


def watch(loop, report, pieces, chosen):
    """Return the largest rise of each V and the least margin on the way, both in the region."""
    largest, steepest = dict.fromkeys(chosen, 0.0), dict.fromkeys(chosen, 0.0)
    unseen = dict.fromkeys(chosen, math.inf)
    closed = ClosedLoop(loop.controller, loop.plant, loop.region, loop.target)
    setting = report.theorem1.setting
    for piece in pieces if chosen else ():
        kept = np.flatnonzero([loop.region.contains(q) for q in piece.q])
        if not len(kept):
            continue
        seen = closed.samples_at(np.zeros(len(kept), dtype=int), piece.q[kept])
        form, follow = MatrixForm(seen, setting), np.diff(kept) == 1
        for name, weights in chosen.items():
            V = lyapunov(loop, seen, setting, weights, piece, kept)
            largest[name] = max(largest[name], float(V.max()))
            steepest[name] = max(steepest[name], float(np.diff(V)[follow].max(initial=0.0)))
            unseen[name] = min(unseen[name], float(form.margins(weights).min()))
    return {name: steepest[name] / max(largest[name], 1e-300) for name in chosen}, unseen


def lyapunov(loop, seen, setting, weights, piece, kept):
    """Return V, with its Σ wᵢSᵢ + ½sᵀΩs, at the recorded instants kept, shape (len(kept),)."""
    v, e = piece.v[kept], piece.error[kept]
    D = law.dissipation(seen.J_hat, setting.kv, setting.B)
    G = (
        law.cross_weight_pinv(seen.J_hat, seen.dJ_hat)[0] @ weights.A1
        + law.cross_weight_damped(D, seen.J_hat, seen.dJ_hat, setting.kv)[0] @ weights.A2
    )
    momentum = np.einsum("kij,kj->ki", seen.M, v)
    Gs = np.einsum("kij,kj->ki", G, seen.s)
    at_rest = weights.at_rest(e, loop.controller.saturation)
    return (momentum * (0.5 * v + Gs)).sum(axis=1) + at_rest


def near_rate(loop, rate):
    """Return the rate at which a small perturbation of the target dies out, simulated [1/s].

    From what is left of the energy ½q̇ᵀMq̇ + ½eᵀK_p e after three and after six of the times that
    the local test tells. Windows of a time hold the swings of modes that oscillate.
    """
    plant, time = loop.plant, 3.0 / abs(rate)
    moved = 1e-5 * np.random.default_rng(0).standard_normal(plant.robot.nv)
    run = aj.simulate(
        plant,
        loop.controller,
        loop.target,
        pin.integrate(plant.robot.model, loop.q_target, moved),
        2.0 * time,
        record_every=time / 400.0,
        dt=None,
        computation=aj.simulation.Computation(rtol=1e-7, atol=1e-12),
    )
    M = plant.dynamics.M(loop.q_target)
    energy = np.einsum("ki,ij,kj->k", run.v, M, run.v)
    energy = energy + (run.error**2) @ loop.controller.diagonals.kp
    return 0.5 * math.log(energy[300:400].max() / energy[700:800].max()) / time


def wrong_way(report):
    """Return the share of configurations where J D⁻¹ĴᵀK_p, the slow motion, has unstable modes."""
    at, setting = report.samples, report.theorem1.setting
    D = law.dissipation(at.J_hat, setting.kv, setting.B)
    flow = at.J @ np.linalg.solve(D, np.swapaxes(at.J_hat, -1, -2)) * setting.kp
    return float((np.linalg.eigvals(flow).real.min(axis=-1) <= 0.0).mean())


def choose_damping(loop, report):
    """Return the first of DAMPINGS that test 2 certifies and with which the motion converges."""
    if report.singular_q is not None:  # whatever the damping
        return None
    if certified_by_test_2(report):
        return DAMPINGS[0]
    for factors in DAMPINGS[1:]:
        other = damped(loop, *factors)
        parts = other.controller, other.plant, other.region, other.target
        # most fail, and few configurations tell
        if certified_by_test_2(assess(*parts, FEW)) and certified_by_test_2(assess(*parts)):
            local = aj.local_stability(other.plant, other.controller, other.q_target)
            if move(other, local.decay_rate)[1]:
                return factors
    return None


def certified_by_test_2(report):
    """Tell if any family of the matrix form certifies."""
    return bool(functions(report).keys() - {"theorem1"})


# -- tables ---------------------------------------------------------------------------------------


def table(outcomes):
    """Return soundness, then conservatism, as Markdown."""
    return "\n".join([*soundness(outcomes), "", *conservatism(outcomes), ""])


def soundness(outcomes):
    """Return what happened where a test certifies, and every counterexample."""
    lines = head(
        "test", "certified", "stayed in the region", "of them converged", "left the region",
        "of them converged", "largest rise of V", "least margin on the way",
    )  # fmt: skip
    for name in TESTS:
        mine = [o for o in outcomes if o.certified[name]]
        stayed, left = ([o for o in mine if o.stayed is where] for where in (True, False))
        rise = max((o.rises[name] for o in mine), default=0.0)
        unseen = min((o.unseen[name] for o in mine), default=math.nan)
        counts = [len(stayed), converged(stayed), len(left), converged(left)]
        lines.append(row(NAMES[name], len(mine), *counts, f"{rise:.1g}", f"{unseen:.2g}"))
    judged = [o for o in outcomes if not math.isnan(o.near_rate)]
    stable = [o for o in judged if o.stable]
    found = [text for o in outcomes for text in o.counterexamples()]
    return [
        *lines,
        "",
        f"Local test: of {len(outcomes)} targets {len(judged)} were judged, the others are nearer "
        f"than 0.001/s to the border. {sum(o.near_rate > 0.0 for o in stable)} of {len(stable)} "
        "that it calls stable drew a small error in, and "
        f"{sum(o.near_rate < 0.0 for o in judged if not o.stable)} of "
        f"{len(judged) - len(stable)} that it calls unstable drove it away.",
        "",
        f"Counterexamples: {len(found)}.",
        *(f"- {text}" for text in found),
    ]


def conservatism(outcomes):
    """Return shares of the cases that converge, by kind and by size of the error."""
    columns = head(
        "", "cases", "converge", *NAMES.values(), "any of test 2", "test 2, damping chosen",
        "locally stable",
    )  # fmt: skip
    lines = ["Of the cases that converge, certified by", "", *columns]
    for kind in dict.fromkeys(o.case.kind for o in outcomes):
        lines.append(shares(kind, [o for o in outcomes if o.case.kind == kind]))
    lines.append(shares("**all**", outcomes))
    lines += ["", "By the size of the error, p over the least σ_min(Ĵ) of the region", "", *columns]
    for low, high in pairwise(BINS):
        mine = [o for o in outcomes if low <= o.jacobian_error < high and not o.singular]
        name = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
        lines += [shares(name, mine)] if mine else []
    singular = [o for o in outcomes if o.singular]
    lines += [shares("Ĵ loses rank in the region", singular)] if singular else []
    missed = missed_cases(outcomes)
    singular = [o for o in missed if o.singular]
    wrong = [o for o in missed if o.wrong_way and not o.singular]
    return [
        *lines,
        "",
        f"Not certified with any damping although they converge: {len(missed)}. In {len(singular)} "
        f"Ĵ loses rank in the region; in {len(wrong)} the region holds configurations that would "
        f"be unstable targets in the limit of large gains; "
        f"{len(missed) - len(singular) - len(wrong)} are left.",
    ]


def missed_cases(outcomes):
    """Return the cases that converge and that nothing certifies."""
    return [o for o in outcomes if o.converged and o.damping is None]


def missing(o):
    """Return a line on a case that converges and that nothing certifies."""
    why = "Ĵ loses rank in the region" if o.singular else f"p/σ_min = {o.jacobian_error:.2g}"
    if o.wrong_way:
        why += f"; {100 * o.wrong_way:.2g} % of the configurations are unstable targets"
    local = "" if o.stable else f"; unstable at the target's configuration ({-o.rate:+.2g}/s)"
    left = "" if o.stayed else "; leaves the region"
    case = f"{o.case.kind}, case {o.case.number}"
    return f"- {case}: {why}, half width {o.radius:.2f} rad{local}{left}"


def shares(name, outcomes):
    """Return a row: how many converge, and what shares of these each test certifies."""
    mine = [o for o in outcomes if o.converged]
    counts = [sum(o.certified[test] for o in mine) for test in TESTS]
    counts.append(sum(any(o.certified[test] for test in TESTS[1:]) for o in mine))
    counts += [sum(o.damping is not None for o in mine), sum(o.stable for o in mine)]
    cells = [f"{100 * n / len(mine):.0f} %" if mine else "–" for n in counts]
    return row(name, len(outcomes), len(mine), *cells)


def converged(outcomes):
    """Return how many converged."""
    return sum(o.converged for o in outcomes)


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/certify")
    options.add_argument("--cases", type=int, default=500, help="random closed loops")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args(arguments)
    count = 24 if given.quick else given.cases
    outcomes = run_all(run_case, cases(count, given.seed), given.jobs)
    found = [text for o in outcomes for text in o.counterexamples()]
    summary = {"cases": count, "counterexamples": found, "runs": outcomes}
    missed = "\n".join(map(missing, missed_cases(outcomes))) + "\n"
    write(given.out, {"certify.md": table(outcomes), "certify_missed.md": missed}, summary)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
