"""Observers of sampled runs: they see every step, and change nothing unless they mean to."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from own_controller import OwnController

import approxjac as aj
from approxjac.robots import GravityRegressor

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def parts(panda, believed_length=0.0):
    truth = panda.with_object(0.2, 0.5, axis="x")
    belief = panda.with_object(believed_length, 0.0, axis="x")
    plant = aj.Plant(truth, aj.PositionTask(truth))
    gravity = aj.AdaptiveGravity(GravityRegressor(belief), L=0.5, alpha=2.0)
    gains = aj.Gains(kp=400.0, kv=80.0, damping=1.0)
    controller = aj.SetpointController(aj.PositionTask(belief), gains, gravity=gravity)
    return plant, controller, plant.sensor.value(START) + [0.05, -0.05, 0.05]


def run(panda, observer=None, **options):
    plant, controller, target = parts(panda)
    options = {"duration": 0.2, "dt": 1e-3, **options}
    return aj.simulate(plant, controller, target, START, observer=observer, **options)


def test_an_observer_that_looks_changes_no_bit(panda):
    seen = []

    def look(loop):
        seen.append((loop.t, *loop.truth.q, *loop.answer.torque, *loop.state, *loop.measurement.x))

    alone, watched = run(panda), run(panda, look)
    for field in dataclasses.fields(alone):
        if field.name not in ("scene", "derived", "engine"):  # the engine says who looked
            a, b = getattr(alone, field.name), getattr(watched, field.name)
            assert_array_equal(a, b)
    expected = np.column_stack([alone.t, alone.q, alone.tau, alone.state, alone.x_measured])
    assert_array_equal(np.array(seen), expected)  # every step, once


@pytest.mark.study
def test_it_moves_the_target(panda):
    _, _, first = parts(panda)
    second = first + [0.0, 0.1, 0.0]

    def move(loop):
        if loop.step == 100:
            loop.aim_at(second)

    moved, alone = run(panda, move, duration=4.0, record_every=0.05), run(panda)
    assert_array_equal(moved.x_d[:3], np.tile(first, (3, 1)))  # that of 0.1 s had the first one
    assert_array_equal(moved.x_d[3:], np.tile(second, (78, 1)))
    assert_array_equal(moved.target, second)
    assert_allclose(moved.error, moved.x - moved.x_d)
    assert_array_equal(moved.q[:3], alone.q[:101:50])
    assert moved.error_norm[3] > moved.error_norm[2] + 0.01
    assert moved.error_norm[-1] < 0.03  # it follows


def test_it_exchanges_the_controller_which_goes_on_with_what_was_learnt(panda):
    better = parts(panda, 0.15)[1]
    states = {}

    def exchange(loop):
        states[loop.step] = loop.state
        if loop.step == 100:
            loop.exchange(better)

    changed, alone = run(panda, exchange), run(panda)
    assert_array_equal(changed.tau[:101], alone.tau[:101])
    assert np.abs(changed.tau[101] - alone.tau[101]).max() > 1e-3
    assert_array_equal(states[101], alone.state[101])  # as the rate was that of the first one
    assert changed.scene.belief == better.task.robot


def test_a_controller_that_does_not_fit_is_refused(panda):
    belief = panda.with_object(0.0)
    task = aj.PositionTask(belief)
    known = aj.SetpointController(task)
    other = aj.SetpointController(aj.PositionTask(belief, axes="xy"))
    learning = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief))
    slow = aj.TorqueLimited(learning, dt=2e-3)
    for controller, message in (
        (known, r"controller must have a state of length \d+, .* with 0"),
        (other, "must have the coordinates of the plant's sensor"),
        (slow, r"dt must be that of the controller, 0.002 \[s\]"),
        (aj.SetpointController, r"controller must be a controller, such as SetpointController"),
    ):
        with pytest.raises(aj.InvalidInputError, match=message):
            run(panda, lambda loop, new=controller: loop.exchange(new))


@pytest.mark.parametrize("every", [None, 0.02])
def test_it_stops_the_run(panda, every):
    def stop(loop):
        if loop.t >= 0.05:
            loop.stop()

    alone, stopped = run(panda), run(panda, stop, record_every=every)
    assert stopped.t[-1] == pytest.approx(0.05)
    assert_array_equal(stopped.q[-1], alone.q[50])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": None}, "dt must be given for an observer, which looks at every sample"),
        ({"observer": "me"}, "observer must be a function of a Loop, got 'me'"),
    ],
)
def test_what_is_no_observer_is_refused(panda, options, message):
    with pytest.raises(aj.InvalidInputError, match=message):
        run(panda, **{"observer": lambda loop: None, **options})


def test_a_target_that_is_none_is_refused(panda):
    with pytest.raises(aj.InvalidInputError, match=r"target must have shape \(3,\)"):
        run(panda, lambda loop: loop.aim_at([0.1, 0.2]))


def test_the_last_record_is_of_one_instant(panda):
    """A target that is moved in the very step of a stop is none that anything was done about."""
    away = parts(panda)[2] + [0.0, 0.3, 0.0]

    def move_and_stop(loop):
        if loop.step == 55:
            loop.aim_at(away)
            loop.stop()

    alone, stopped = run(panda), run(panda, move_and_stop, record_every=0.02)
    assert stopped.t[-1] == pytest.approx(0.055)
    for name in ("x_d", "error", "tau", "V"):
        assert_array_equal(getattr(stopped, name)[-1], getattr(alone, name)[55])


@pytest.mark.parametrize("error", [None, RuntimeError])
def test_an_observer_is_closed_however_a_run_ends(panda, error):
    closed = []

    class Observer:
        def __call__(self, loop):
            if error is not None and loop.step == 3:
                raise error

        def __enter__(self):
            return self

        def __exit__(self, *error):
            closed.append(True)

    if error is None:
        run(panda, Observer())
    else:
        with pytest.raises(error):
            run(panda, Observer())
    assert closed == [True]


def test_a_target_that_overflows_is_refused(panda):
    with pytest.raises(aj.InvalidInputError, match="target must be at most"):
        run(panda, lambda loop: loop.aim_at([1e308, 1e308, 1e308]))


def test_a_target_that_is_moved_leaves_the_torque_of_its_step(panda):
    """Also where a controller uses one buffer for all its torques."""

    class Buffered(OwnController):
        def __init__(self, controller):
            super().__init__(controller.task)
            self.controller = controller
            self.buffer = np.zeros(7)

        def begin(self, measurement):
            return self.controller.begin(measurement)

        def evaluate(self, state, measurement, target):
            answer = self.controller.evaluate(state, measurement, target)
            self.buffer[:] = answer.torque
            return answer._replace(torque=self.buffer)

    plant, _, target = parts(panda)
    law = aj.SetpointController(aj.PositionTask(panda.with_object(0.0)))

    def move(loop):
        if loop.step == 10:
            loop.aim_at(target + [0.0, 0.2, 0.0])

    plain, buffered = (
        aj.simulate(plant, controller, target, START, 0.03, dt=1e-3, observer=move)
        for controller in (law, Buffered(law))
    )
    assert_array_equal(plain.q, buffered.q)
    assert_array_equal(plain.tau, buffered.tau)
