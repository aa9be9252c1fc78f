"""Limits of speed, position, rate and motion in compiled steps, whole runs and C."""

import functools
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from codegen.test_c99 import InC, needs_compiler
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.codegen.step import compiled
from approxjac.controllers import CartesianSpeed, Limit, Wall
from approxjac.interface import LimitStatus
from approxjac.simulation.simulate import SampledLoop


class HighElbow(Limit):
    """A limit of the user's own, which knows nothing of symbols."""

    def rows(self, terms, v, dt):
        z = terms.position("panda_link4")[2:] - 0.4
        return terms.stay_above(
            z, terms.jacobian("panda_link4")[2:3], terms.drift("panda_link4")[2:3]
        )


FLOOR = Wall([0.0, 0.0, 0.2], [0.0, 0.0, 1.0], 0.05)
LIMITERS = {
    "URDF": ("panda", {}, lambda of: of, {}),
    "rate": ("panda", {}, lambda of: replace(of, rate=3000.0), {"dt": 2e-3}),
    "learnt": ("panda", {"gravity": aj.AdaptiveGravity}, lambda of: of, {"dt": 5e-4}),
    "no proof": ("ur5", {}, lambda of: replace(of, acceleration=20.0), {"proof": False}),
    "continuous joints": ("kinova", {}, lambda of: of, {}),
    "motion": ("panda", {}, lambda of: [of, FLOOR, CartesianSpeed(0.5), HighElbow()], {}),
}


def limiter(name):
    arm, law, limits, options = LIMITERS[name]
    robot = aj.load_robot(arm)
    made = {key: value(robot) for key, value in law.items()}
    controller = aj.SetpointController(aj.PositionTask(robot), **made)
    return aj.TorqueLimited(controller, limits(aj.Limits.of(robot, scale=0.5)), **options)


def steps(controller, count, rng):
    """Measurements and targets of two periods each, slow and fast, near and far."""
    robot, dt = controller.task.robot, controller.dt
    for _ in range(count):
        q = robot.random_configuration(rng)
        v = rng.uniform(-1.0, 1.0, robot.nv) * rng.choice([0.1, 1.5])
        x = controller.task.value(q)
        target = x + rng.normal(size=3) * rng.choice([0.02, 0.3])
        yield [aj.Measurement(k * dt, q, v + 0.01 * k, x) for k in range(2)], target


MARKS = {"URDF": pytest.mark.long}  # "motion" has all of it


@pytest.mark.parametrize(
    "name",
    [
        n if n == "motion" else pytest.param(n, marks=MARKS.get(n, pytest.mark.study))
        for n in LIMITERS
    ],
)
def test_compiled_steps_are_those_of_python(name, rng):
    """To the accuracy of two solvers; what no torque keeps is left to Python, to the bit."""
    plain = limiter(name)
    quick, seen = compiled(plain), set()
    for measurements, target in steps(plain, 120, rng):
        states = [plain.initial_state(measurements[0])] * 2
        for measurement in measurements:
            (ours, found), (theirs, expected) = (
                each.step(state, measurement, target, plain.dt)
                for each, state in zip((quick, plain), states, strict=True)
            )
            assert found.limit_status is expected.limit_status
            size = max(1.0, np.abs(expected.torque).max())
            assert_allclose(found.torque, expected.torque, atol=1e-6 * size)
            assert_allclose(found.slack, expected.slack, rtol=1e-5, atol=1e-6)
            assert_allclose(ours, theirs, rtol=1e-6, atol=1e-5)
            if expected.limit_status is aj.LimitStatus.INFEASIBLE:
                assert_array_equal(found.torque, expected.torque)
            states = [theirs, theirs]
            seen.add(expected.limit_status.name)
    assert "FREE" in seen
    assert "INFEASIBLE" in seen or name == "no proof"
    assert seen & {"PROOF_KEPT", "LIMITED"}


@pytest.mark.parametrize(
    ("proof", "limit"),
    [(True, {"rate": 900.0}), (False, {"rate": 900.0}), (False, {"velocity": 0.5})],
)
def test_what_joints_at_no_limit_learn_is_learnt_in_compiled_steps(proof, limit, rng):
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm)
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(arm))
    plain = aj.TorqueLimited(law, aj.Limits(effort=40.0, **limit), proof=proof)
    quick, learnt = compiled(plain), 0
    for _ in range(100):
        q = arm.random_configuration(rng)
        measured = aj.Measurement(0.0, q, 0.6 * rng.normal(size=2), task.value(q))
        state = plain.initial_state(measured)
        if "rate" in limit:  # the torque before is at the limit of the first motor
            state[plain.size - 2 : plain.size] = 39.9, 0.0
        target = measured.x + 0.03 * rng.normal(size=2)
        (after, answer), (same, _) = (
            each.step(state, measured, target, 1e-3) for each in (plain, quick)
        )
        assert_allclose(same, after, rtol=1e-6, atol=1e-9)
        gives_up = answer.limit_status in (LimitStatus.PROOF_GIVEN_UP, LimitStatus.LIMITED)
        learnt += gives_up and (after[: law.resting] != state[: law.resting]).any()
    assert learnt


@pytest.mark.study
def test_another_period_and_a_clock_that_jumps_are_judged_as_in_python():
    plain = limiter("URDF")
    quick = compiled(plain)
    measurement = next(steps(plain, 1, np.random.default_rng(0)))[0][0]
    state = quick.initial_state(measurement)
    with pytest.raises(aj.InvalidInputError, match="dt must be"):
        quick.step(state, measurement, measurement.x, 2e-3)
    for t in (1e-3, 5.0, np.nan):  # when it was expected, and not
        after = []
        for each in (quick, plain):
            state, _ = each.step(
                each.initial_state(measurement), measurement, measurement.x + 0.1, 1e-3
            )
            later = measurement._replace(t=t, v=measurement.v + 0.05)
            after.append(each.step(state, later, measurement.x + 0.1, 1e-3)[0])
        assert_allclose(*after, rtol=1e-9, atol=1e-9)


@pytest.mark.study
def test_a_whole_run_is_that_of_python(panda, monkeypatch):
    """Into a wall, with the limits of the URDF and a rate."""
    truth, belief = panda.with_object(0.1, 0.5, axis="x"), panda.with_object(0.0, 0.5, axis="x")
    plant = aj.Plant(truth)
    start = plant.ready_configuration()
    x = plant.sensor.value(start)
    wall = Wall(x + [0.0, 0.3, 0.0], [0.0, -1.0, 0.0], 0.1)
    limits = [replace(aj.Limits.of(belief), rate=1000.0), wall, CartesianSpeed(0.3)]
    plain = aj.TorqueLimited(aj.SetpointController(aj.PositionTask(belief)), limits)
    options = {
        "duration": 1.2,
        "dt": 1e-3,
        "computation": aj.simulation.Computation("semi_implicit_euler"),
    }
    expected = aj.simulate(plant, plain, x + [0.0, 0.4, 0.0], **options)
    quick = compiled(plain)
    monkeypatch.delattr(SampledLoop, "advance")
    found = aj.simulate(plant, quick, x + [0.0, 0.4, 0.0], **options)
    assert len(set(expected.limit_status)) > 1
    assert np.mean(found.limit_status == expected.limit_status) > 0.99
    for part in ("q", "v", "x"):
        assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-5, err_msg=part)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Limiters by name, in Python and in C, and the folders of these; each is written once."""

    @functools.cache
    def exported_(name):
        controller, folder = limiter(name), tmp_path_factory.mktemp(name)
        return controller, InC(controller, folder), folder

    return exported_


@needs_compiler
@pytest.mark.study
@pytest.mark.parametrize(
    "name",  # those of a rate: to the bit in the self-test
    [*(pytest.param(name, marks=pytest.mark.long) for name in ("URDF", "rate")), "motion"],
)
def test_in_C_they_are_those_of_python(name, exported, rng):
    """Also where no torque keeps them: there C brakes by itself."""
    controller, in_c, folder = exported(name)
    assert "what the controller keeps" in (folder / "controller.h").read_text("utf-8")
    apart, seen = [], set()
    for measurements, target in steps(controller, 60, rng):
        state, kept = controller.initial_state(measurements[0]), in_c.init(measurements[0])
        for measurement in measurements:
            state, expected = controller.step(state, measurement, target, controller.dt)
            t, q, v, x, t_x = measurement
            _, kept, found = in_c.step(kept, q, v, x, target, controller.dt, t, t_x)
            assert int(found["limit_status"][0]) == expected.limit_status
            size = max(1.0, np.abs(expected.torque).max())
            apart.append(np.abs(found["torque"] - expected.torque).max() / size)
            if expected.limit_status is not aj.LimitStatus.INFEASIBLE:
                assert apart[-1] < 1e-6
            assert (np.abs(found["torque"]) <= controller.limits.effort).all()
            seen.add(expected.limit_status.name)
    assert {"FREE", "INFEASIBLE", "PROOF_KEPT"} <= seen
    assert np.mean(np.array(apart) < 1e-6) > 0.95  # DAQP gives some up that may be solved


@needs_compiler
@pytest.mark.long
def test_the_self_test_of_all_limits_passes(exported):
    _, _, folder = exported("rate")
    made = "cc -std=c99 -O0 -ffp-contract=off selftest.c controller.c -lm -o selftest && ./selftest"
    run = subprocess.run(made, shell=True, cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "50 of 50 steps to the bit" in run.stdout
