"""Attack the certificate of the sampled loop: sampled, late, with x in frames and a filtered q̇.

A setup is a random arm with a tool that may be longer and heavier than believed, gains, damping,
friction, saturation, a box, delays, images and a filter. Its period is the longest of a few that
are certified, near what the loop is stable with at all. Certified ones are attacked: with true
robots from inside the box of errors linearised as they run, with recorded runs along which V must
not rise above its start, with such runs whose periods vary and whose arm is moving when they begin
(`uneven`), and with rollouts in lanes, which must not diverge unless they leave the box.

    python examples/studies/attack_certificate.py --out results/attack_certificate

docs/tables/attack_certificate.md is its table. Exit code 1 means that a counterexample was found.
"""

import itertools
import math
import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from attacks import (
    DURATION,
    LONGEST,
    in_lanes,
    linearised,
    moved,
    on_its_own_clock,
    radii,
    watched,
)
from common import carried_object, head, parser, row, run_all, write

import approxjac as aj
from approxjac.controllers import Latency
from approxjac.stability.certificates.certificate import continuous_test
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.search.worst import searched_test

ARMS = (
    "two_link", "panda", "ur5", "xarm7", "kinova", "z1", "ur10", "so101", "talos_arm", "tiago_arm",
    "baxter_left_arm",
)  # fmt: skip
POSES = ("ur5", "kinova", "ur10", "z1")  # half of their tasks have as many coordinates
SAMPLES = 100  # to choose a function on, and again to check it
SHARES = (0.76, 0.6, 0.45, 0.3, 0.15, 0.05)  # of the exact period, the longest first
INNER = 12  # true robots from inside
RECORDED, UNEVEN = 3, 6  # runs along which V is watched
LANES = 1500  # rollouts of a setup
RISE = 1e-6  # of V above its start that is round-off


class Outcome(NamedTuple):
    """What became of a setup."""

    name: str
    latency: Latency | None  # None where no period was certified
    share: float  # of the longest stable period
    margin: float
    growth: np.ndarray  # of the inner linearisations
    rises: list  # largest V(t)/V(0) − 1 of recorded runs
    kept: int  # recorded runs that stayed in the box
    uneven: list  # largest V(t)/V(0) − 1 of runs whose periods vary
    kept_uneven: int  # of these
    rollouts: int
    diverged: int  # of those that stayed in the box
    left: int  # the box

    def counterexamples(self):
        """Return what contradicts the certificate, in words."""
        found = [f"errors grow by {g:.6f} from frame to frame" for g in self.growth if g >= 1.0]
        found += [f"V rises by {rise:.2g} above its start" for rise in self.rises if rise > RISE]
        found += [f"V rises by {rise:.2g} above its start, with periods that vary"
                  for rise in self.uneven if rise > RISE]  # fmt: skip
        found += [f"{self.diverged} rollouts diverge"] if self.diverged else []
        return [f"{self.name}, {self.latency!r}: {text}" for text in found]


# -- setups ---------------------------------------------------------------------------------------


def draw(number, seed):
    """Return the closed loop of a setup, its errors, and its latency in periods of 1 s."""
    rng = np.random.default_rng([seed, number])
    name = ARMS[number % len(ARMS)]
    robot, (length, mass) = aj.load_robot(name), carried_object(name)
    weightless = rng.random() < 0.6
    held = {"object_length": (0.0, length * rng.uniform(0.25, 1.5))}
    if weightless:
        robot = robot.with_gravity((0.0, 0.0, 0.0))
        held["object_mass"] = (0.0, mass * rng.uniform())
    task = aj.PoseTask if name in POSES and rng.random() < 0.5 else None
    plain = aj.Uncertainty(robot, task, **held)
    believed = plain.believed_task()
    usual = aj.default_gains(believed)
    kp, kv = (factor * np.asarray(gain) for factor, gain in zip(
        3.0 ** rng.uniform(-1.0, 1.0, 2), (usual.kp, usual.kv), strict=True
    ))  # fmt: skip
    half = rng.uniform(0.05, 0.2)
    q = regular(plain, half, rng)
    damping = np.maximum(usual.damping, 0.05 * np.max(kv)) * np.ones(robot.nv)
    if rng.random() < 0.6:  # in the shape of inertia, with which periods may be longer
        damping = 10.0 * np.diag(aj.Plant(robot).dynamics.M(q)) + 0.003 * np.max(kv)
    damping = damping * 4.0 ** rng.uniform(-1.0, 1.0)
    # rollouts take friction in steps of a period: no more of it than that bears
    friction = 0.3 * damping * rng.uniform() if rng.random() < 0.5 else 0.0
    errors = replace(plain, friction=friction)
    saturation = aj.law.Linear()
    if rng.random() < 0.5:
        size = half * float(np.linalg.norm(believed.jacobian(q), 2))
        saturation = (aj.law.Sine, aj.law.Tanh)[rng.integers(2)](size * rng.uniform(0.2, 2.0))
    gravity = aj.NoGravity(believed.robot) if weightless else None
    controller = aj.SetpointController(
        believed, aj.Gains(kp, kv, damping), gravity=gravity, saturation=saturation
    )
    every = int(rng.choice([0, 0, 1, 5, 17, 33]))
    latency = Latency(
        1.0, float(rng.integers(3)), float(rng.choice([0.0, 0.0, 0.0, 1.0, 4.0])), float(every),
        float(rng.integers(2 * every + 1)),
    )  # fmt: skip
    return controller, errors, aj.JointBox.around(errors.arm, q, half), latency, rng


def regular(errors, half, rng):
    """Return the middle of a box within the joint limits, where no Jacobian is nearly singular."""
    low, high = errors.arm.position_limits
    tasks = [errors.believed_task(), *(errors.plant(each).sensor for each in errors.corners())]
    for drawn in itertools.count():
        least = 0.1 * 0.5 ** (drawn // 500)  # some arms have few such configurations
        q = errors.arm.random_configuration(rng)
        at = pin.difference(errors.arm.model, errors.arm.neutral(), q)
        if (at - half < low).any() or (at + half > high).any():
            continue  # stops are nothing that a certificate speaks of
        sizes = [np.linalg.svd(task.jacobian(q), compute_uv=False) for task in tasks]
        if all(values[-1] > least * values[0] for values in sizes):
            return q


def in_seconds(latency, period):
    """Return a latency whose times are counted in periods with another one [s]."""
    times = ("period", "torque_delay", "velocity_filter", "image_period", "image_age")
    return Latency(*(period * getattr(latency, name) for name in times))


def longest_stable(loop, samples, latency):
    """Return the longest period that no sample's exact linearisation grows with [s]."""
    low, high = 1e-6, 1.0
    while high > 1.05 * low:
        middle = math.sqrt(low * high)
        stable = (radii(loop, samples, in_seconds(latency, middle)) < 1.0).all()
        low, high = (middle, high) if stable else (low, middle)
    return low


# -- attack ---------------------------------------------------------------------------------------


def attack(case):
    """Certify a setup, if it can be, and hold the certificate against what happens."""
    number, seed, runs = case
    controller, errors, region, counted, rng = draw(number, seed)
    name = f"{ARMS[number % len(ARMS)]}, {type(controller.task).__name__}, setup {number}"
    loop = ClosedLoop(controller, errors, region)
    try:
        first, fresh = (loop.draw(SAMPLES, rng) for _ in range(2))
    except aj.errors.InvalidInputError:  # Ĵ loses rank in the box
        return nothing(name)
    if not continuous_test(loop, first).certified:
        return nothing(name)
    longest = longest_stable(loop, first.take(slice(24)), counted)

    def certificate(latency):
        return searched_test(loop, latency, first, rng).checked_on(fresh)

    for share in SHARES:
        latency = in_seconds(counted, share * longest)
        test = certificate(latency)
        if test.certified and test.level > 0.0:
            break
    else:
        return nothing(name)
    inner = [errors.plant(errors.sample(rng)) for _ in range(INNER)]
    grown = np.concatenate([linearised(controller, plant, region, latency, rng)
                            for plant in inner])  # fmt: skip
    recorded = [watched(controller, plant, region, test, latency, rng)
                for plant in inner[:RECORDED]]  # fmt: skip
    own, free = test, on_its_own_clock(latency)
    if free != latency:
        own = certificate(free)
    moving = []
    if own.certified and own.level > 0.0:
        moving = [moved(controller, inner[k % INNER], region, own, free, rng, k % 2 == 0)
                  for k in range(UNEVEN)]  # fmt: skip
    columns = in_lanes(controller, errors, region, latency, runs, seed)
    return Outcome(
        name, latency, share, test.margin, grown, [rise for rise, _ in recorded],
        sum(stayed for _, stayed in recorded), [rise for rise, _ in moving],
        sum(stayed for _, stayed in moving), runs,
        int((columns["diverged"] & columns["stayed"]).sum()), int((~columns["stayed"]).sum()),
    )  # fmt: skip


def nothing(name):
    """Return that a setup was not certified."""
    return Outcome(name, None, 0.0, 0.0, np.zeros(0), [], 0, [], 0, 0, 0, 0)


# -- table ----------------------------------------------------------------------------------------


def table(outcomes):
    """Return what was attacked and what came of it, as Markdown."""
    lines = head(
        "arm", "setups", "certified", "period over the longest stable, median", "linearisations",
        "1 − growth, least", "recorded runs", "largest V(t)/V(0) − 1", "uneven runs",
        "largest V(t)/V(0) − 1", "rollouts", "diverged inside the box", "left the box",
    )  # fmt: skip
    names = dict.fromkeys(o.name.split(",")[0] for o in outcomes)
    for name in names:
        lines.append(summed(name, [o for o in outcomes if o.name.split(",")[0] == name]))
    lines.append(summed("**all**", outcomes))
    certified = [o for o in outcomes if o.latency]
    kinds = {
        "torque delay": lambda t: t.torque_delay, "images": lambda t: t.image_period,
        "filter of q̇": lambda t: t.velocity_filter,
        "none of these": lambda t: t == Latency(t.period),
    }  # fmt: skip
    told = (f"{sum(bool(of(o.latency)) for o in certified)} with {kind}"
            for kind, of in kinds.items())  # fmt: skip
    found = [text for o in outcomes for text in o.counterexamples()]
    return "\n".join([
        *lines, "",
        f"Of the certified {len(certified)}: {', '.join(told)}. Rollouts last {DURATION:g} s, or "
        f"{LONGEST} periods if that is less.",
        "", f"Of the uneven runs {sum(o.kept_uneven for o in certified)} stayed in the box; V was "
        "watched up to the first exit. Their periods vary between a tenth and all of the certified "
        "one, and frames come on a clock of their own. In every other one the arm moves at the "
        "start, with V(0) of 0.3 to 0.9 of the certified level.",
        "", f"Counterexamples: {len(found)}.", *(f"- {text}" for text in found), "",
        "`python examples/studies/attack_certificate.py` writes this.", "",
    ])  # fmt: skip


def summed(name, outcomes):
    """Return a row."""
    mine = [o for o in outcomes if o.latency]
    if not mine:
        return row(name, len(outcomes), 0, *["–"] * 10)
    rises, odd = ([each for o in mine for each in getattr(o, name)] for name in ("rises", "uneven"))
    counts = [sum(getattr(o, field) for o in mine) for field in
              ("rollouts", "diverged", "left")]  # fmt: skip
    return row(
        name, len(outcomes), len(mine), f"{np.median([o.share for o in mine]):.2f}",
        sum(len(o.growth) for o in mine), f"{1.0 - max(o.growth.max() for o in mine):.1g}",
        len(rises), f"{max(rises):.1g}", len(odd), f"{max(odd):.1g}" if odd else "–", *counts,
    )  # fmt: skip


def main():
    """Run the study from the command line."""
    options = parser(__doc__, "results/attack_certificate")
    options.add_argument("--setups", type=int, default=48)
    options.add_argument("--seed", type=int, default=22)
    args = options.parse_args()
    setups, runs = (len(ARMS), 200) if args.quick else (args.setups, LANES)
    outcomes = run_all(attack, [(k, args.seed, runs) for k in range(setups)], args.jobs)
    found = [text for o in outcomes for text in o.counterexamples()]
    summary = {"setups": setups, "seed": args.seed, "counterexamples": found}
    write(args.out, {"attack_certificate.md": table(outcomes)}, summary)
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
