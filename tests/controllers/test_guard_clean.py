"""Hours of runs in which nothing is wrong: no sample may be refused."""

import math

import numpy as np
import pytest

import approxjac as aj
from approxjac import law
from approxjac.controllers import ControllerWrapper, Latency

ARMS = "kinova", "z1", "xarm7", "baxter_left_arm", "ur10", "talos_arm", "ur3", "panda"


USUAL = aj.controllers.Guard()


class Alarm(ControllerWrapper):
    """Commands far too much from the first refused sample on: the run diverges, in lanes too."""

    guard = None  # but its own

    def __init__(self, controller):
        object.__setattr__(self, "controller", controller)

    def begin(self, measurement):
        return np.concatenate([self.controller.initial_state(measurement), [0.0]])

    def advance(self, state, measurement, target, dt):
        inner, answer = self.controller.step(state[:-1], measurement, target, dt)
        is_bad = answer.status >= float(aj.Status.JOINTS_UNKNOWN)
        count = state[-1] + law.select(is_bad, 1.0, 0.0)
        answer = answer._replace(torque=answer.torque + 1e9 * count, state_rate=None)
        return np.concatenate([inner, law.array([count])]), answer


def diverged(seed, runs, duration, guard=USUAL, *, real=False):
    """Return how many runs of an arm, a law, a period and sensors drawn by this seed diverge.

    The tool's length and mass are uncertain; all start and end near one pose, away from stops. If
    `real`, gears are elastic and joints rub.
    """
    rng = np.random.default_rng(seed)
    arm = aj.load_robot(str(rng.choice(ARMS)))
    kind, bits = rng.choice(["learnt", "limited", "tracking"]), rng.choice([12, 14, 16, 18, 20])
    longest = 5e-3 if kind == "limited" else 2e-3  # of a stable loop on light wrists
    periods = [dt for dt in (2.5e-4, 5e-4, 1e-3, 2e-3, 5e-3) if dt <= longest]
    dt, v_filter = float(rng.choice(periods)), float(rng.choice([2e-3, 5e-3]))
    late = {"x_noise": 1e-3, "x_rate": float(rng.choice([30.0, 100.0])), "x_delay": 0.02}
    sensing = aj.Sensing(
        q_quantum=2.0 * math.pi / 2**bits, velocity_filter=5e-3 if bits < 16 else v_filter,
        **late if rng.random() < 0.7 else {},
    )  # fmt: skip
    friction, drives = float(rng.choice([0.0, 0.3])), None
    if real:
        friction, drives = joints_of(arm, rng)
    errors = aj.Uncertainty(
        arm, object_length=(0.05, 0.2), object_mass=(0.0, 0.5), believed_length=0.1,
        believed_mass=0.0, object_axis="x", friction=friction, drives=drives,
    )  # fmt: skip
    task = errors.nominal.sensor
    latency = Latency(dt, velocity_filter=sensing.velocity_filter)
    gravity = aj.AdaptiveGravity(task.robot)
    learnt = aj.SetpointController(task, gravity=gravity, latency=latency)
    known = {"latency": latency} if real else {"dt": dt}
    controller = {
        "learnt": learnt,
        "limited": aj.TorqueLimited(learnt, aj.Limits.of(task.robot)),
        "tracking": aj.TrackingController(task, **known),
    }[str(kind)]
    pose = aj.Plant(arm).ready_configuration()
    region = aj.JointBox(arm, -0.25, 0.25, center=pose)
    study = aj.Study(
        Alarm(controller.guarded(guard)), errors, region, sensing=sensing, duration=duration,
        latency=Latency(dt), seed=seed,
    )  # fmt: skip
    lanes = aj.stability.Execution(engine="lanes")
    return int(study.rollouts(runs, execution=lanes).columns["diverged"].sum())


def joints_of(arm, rng):
    """Friction and drives of an arm's joints, drawn."""
    usual, effort = aj.robots.Drives.usual(arm), aj.robots.drives.usual_effort(arm)
    softer, share = rng.choice([1.0, 0.5, 0.3]), rng.choice([0.0, 0.01, 0.05, 0.1])
    drives = aj.robots.Drives(usual.rotor_inertia, softer * np.asarray(usual.stiffness))
    friction = aj.robots.Friction(
        float(rng.choice([0.3, 1.0])), share * effort, stribeck=float(rng.choice([1.0, 1.3]))
    )
    return friction, drives


@pytest.mark.study
@pytest.mark.parametrize(("seed", "runs", "duration"), [(0, 8, 1.0), (1, 16, 5.0), (2, 16, 5.0)])
def test_no_good_sample_is_refused(seed, runs, duration):
    assert diverged(seed, runs, duration) == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *range(3, 40)])
def test_no_good_sample_is_refused_in_four_hours(seed):
    assert diverged(seed, 40, 10.0) == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(100, 140))
def test_no_good_sample_of_elastic_joints_that_rub_is_refused(seed):
    assert diverged(seed, 40, 10.0, real=True) == 0


@pytest.mark.study
def test_what_is_refused_would_be_seen():
    assert diverged(0, 8, 1.0, aj.controllers.Guard(q=1e-7, lag=0.0)) == 8
