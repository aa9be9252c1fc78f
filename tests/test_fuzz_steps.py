"""Steps of every controller on what nobody should give it: 10⁶ of them in the study.

Of the state, the measurement, the target and the times of a usual step some entries are made
absurd: NaN, infinite, huge, tiny, or masked. A step, and a first state, is finite, or a named error
says why not; pytest turns warnings into errors. `pytest -m study tests/test_fuzz_steps.py` prints
how many there were with -s.
"""

import collections
import functools
import time

import numpy as np
import pinocchio as pin
import pytest
import test_fuzz

import approxjac as aj
from approxjac.controllers import AdaptiveCamera, AdaptiveKinematics, PredictedMeasurement

RATE = aj.Limits(effort=50.0, rate=100.0)


@functools.cache
def controllers():
    """Those of test_fuzz, and more that remember torques, frames, or what was seen."""
    panda, kinova, slider = (
        aj.load_robot("panda"), aj.load_robot("kinova"), test_fuzz.prismatic_arm()
    )  # fmt: skip
    task, tool, turning = aj.PositionTask(panda), aj.PositionTask(slider), aj.PositionTask(kinova)
    image = aj.ImageTask(panda, test_fuzz.CAMERA)
    gains, only = aj.Gains(100.0, 20.0, 1.0), aj.Limits(rate=100.0)
    learns = aj.SetpointController(task, gravity=aj.AdaptiveGravity(panda))
    sliding = aj.SetpointController(tool, gains)
    return test_fuzz.controllers() | {
        "limits of the URDF": aj.TorqueLimited(learns),
        "rate": aj.TorqueLimited(learns, only),
        "rate, continuous joints": aj.TorqueLimited(aj.SetpointController(turning), RATE),
        "rate, prismatic": aj.TorqueLimited(sliding, only),
        "huge rate, prismatic": aj.TorqueLimited(sliding, aj.Limits(rate=1e300)),
        "rate, prismatic, learnt": aj.TorqueLimited(
            aj.SetpointController(tool, gains, gravity=aj.AdaptiveGravity(slider)), RATE
        ),
        "rate, tracking": aj.TorqueLimited(aj.TrackingController(task), RATE),
        "rate, tracking, prismatic": aj.TorqueLimited(aj.TrackingController(tool), only),
        "held": aj.HeldMeasurement(aj.TorqueLimited(learns, RATE), 0.1),
        "held, prismatic": aj.HeldMeasurement(aj.TorqueLimited(sliding, only), 0.1),
        "held, image": aj.HeldMeasurement(aj.SetpointController(image), 30.0),
        "tracking, learns": aj.TrackingController(task),
        "tracking, learns by a pose": aj.TrackingController(aj.PoseTask(panda)),
        "tracking, learns a camera": aj.TrackingController(image, kinematics=AdaptiveCamera(image)),
        "predicted": PredictedMeasurement(
            aj.SetpointController(task), AdaptiveKinematics(task)
        ),
    } | {name: test_fuzz.compiled_controller(name) for name in test_fuzz.COMPILED[:3]}  # fmt: skip


MORE = (
    "limits of the URDF", "rate", "rate, continuous joints", "rate, prismatic",
    "huge rate, prismatic", "rate, prismatic, learnt", "rate, tracking",
    "rate, tracking, prismatic", "held", "held, prismatic", "held, image", "tracking, learns",
    "tracking, learns by a pose", "tracking, learns a camera", "predicted",
)  # fmt: skip
NAMES = (*test_fuzz.NAMES, *MORE, *test_fuzz.COMPILED[:3])


def spoilt(array, rng, share):
    """Return an array, of which some entries are absurd with this probability, or hidden."""
    array, kind = np.array(array), rng.random() / share
    if not len(array) or kind > 1.0:
        return array
    if kind < 0.6:
        array[rng.integers(len(array), size=2)] = rng.choice(test_fuzz.EXTREMES, 2)
    elif kind < 0.8:
        with np.errstate(over="ignore", under="ignore"):
            array *= 10.0 ** rng.uniform(-320.0, 308.0)
    elif kind < 0.9:
        array[:] = rng.choice(test_fuzz.EXTREMES)
    else:
        return np.ma.masked_array(array, rng.random(len(array)) < 0.5)
    return array


class Steps:
    """Usual steps of a controller, and what becomes of them."""

    def __init__(self, controller, seed):
        self.controller, self.rng = controller, np.random.default_rng(seed)
        robot = controller.task.robot
        self.places = [
            pin.integrate(robot.model, robot.neutral(), motion)
            for motion in self.rng.normal(size=(20, robot.nv))
        ]
        self.values = [controller.task.value(q) for q in self.places]
        self.found = collections.Counter()

    def number(self):
        rng = self.rng
        return float(rng.choice(test_fuzz.EXTREMES)) if rng.random() < 0.15 else rng.random()

    def measurement(self, share):
        i, rng = self.rng.integers(20), self.rng
        v = rng.normal(size=self.controller.task.robot.nv)
        if share == 0.0:
            return aj.Measurement(0.0, self.places[i], v, self.values[i])
        q, v, x = spoilt(self.places[i], rng, share), spoilt(v, rng, share), self.values[i]
        t_x = None if rng.random() < 0.5 else self.number()
        return aj.Measurement(self.number(), q, v, spoilt(x, rng, share), t_x)

    def first(self):
        """Return a first state, or one that is usual where that is refused."""
        try:
            state = self.controller.initial_state(self.measurement(0.2))
        except aj.errors.ApproxJacError as error:
            assert len(str(error)) > 20  # noqa: PT017
            self.found["first state refused"] += 1
            return self.controller.initial_state(self.measurement(0.0))
        assert np.isfinite(state).all()
        self.found["first state"] += 1
        return state

    def step(self, state):
        """Take a step; return the state after it."""
        rng = self.rng
        target = spoilt(self.values[rng.integers(20)], rng, 0.15)
        dt = 1e-3 if rng.random() < 0.9 else float(rng.choice(test_fuzz.EXTREMES))
        told = spoilt(state, rng, 0.3)
        try:
            after, answer = self.controller.step(told, self.measurement(0.2), target, dt)
        except aj.errors.ApproxJacError as error:
            assert len(str(error)) > 20  # noqa: PT017
            self.found["refused"] += 1
            return state
        assert type(answer.torque) is type(after) is np.ndarray
        assert np.isfinite(answer.torque).all()
        assert np.isfinite(after).all()
        assert after.shape == state.shape
        self.found[answer.status.name] += 1
        own, guard = np.split(np.abs(after), [self.controller.size])
        is_usual = own.max(initial=0.0) < 1e6 and guard.max(initial=0.0) < 1e30
        return after if is_usual else state

    def take(self, count):
        for k in range(count):
            if k % 50 == 0:
                state = self.first()
            state = self.step(state)


@pytest.mark.parametrize("name", NAMES)
def test_absurd_steps_are_finite_or_named_errors(name):
    steps = Steps(controllers()[name], seed=len(name))
    steps.take(40)
    assert steps.found["refused"] > 0
    assert steps.found.total() - steps.found["refused"] > 5


@pytest.mark.long
@pytest.mark.parametrize("count", [5_000, 1_000_000])
def test_very_many_absurd_steps(count):
    found, start = collections.Counter(), time.perf_counter()
    for seed, (name, controller) in enumerate(controllers().items()):
        steps = Steps(controller, seed)
        steps.take(count // len(NAMES) + 1)
        found += steps.found
        assert steps.found["refused"] > count // 1000, name
    assert found.total() > count
    print(f"\n{found.total()} in {time.perf_counter() - start:.0f} s: {dict(found)}")


def test_every_controller_is_there():
    assert tuple(controllers()) == NAMES
