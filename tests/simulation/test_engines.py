"""What carries a run out, and what it says about that."""

import importlib.util
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from own_controller import OwnController

import approxjac as aj
from approxjac.codegen import whole_run
from approxjac.errors import InvalidInputError, SimulationError, UnknownNameError
from approxjac.robots import Drives
from approxjac.simulation import Computation, InitialState, Trajectory


@pytest.fixture
def loop(two_link):
    """A plant, a law, a target and a start."""
    task = aj.PositionTask(two_link, axes="xz")
    q = np.array([0.4, 0.9])
    return aj.Plant(two_link, task), aj.SetpointController(task), task.value(q + 0.2), q


def test_long_runs_are_compiled_and_say_so(loop):
    python = aj.simulate(
        *loop, 6.0, computation=aj.simulation.Computation(engine="python"), record_every=0.1
    )
    run = aj.simulate(*loop, 6.0, record_every=0.1)
    assert (python.engine, run.engine) == ("Python", "machine code")
    assert "engine" in str(run)
    for name in ("q", "v", "x", "tau", "error"):
        expected = getattr(python, name)
        np.testing.assert_allclose(getattr(run, name), expected, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(run.status, python.status)


def test_short_runs_are_compiled_where_that_is_asked_for(loop):
    assert aj.simulate(*loop, 0.1).engine == "Python"
    assert (
        aj.simulate(*loop, 0.1, computation=aj.simulation.Computation(engine="compiled")).engine
        == "machine code"
    )
    assert (
        aj.simulate(*loop, 0.1, computation=aj.simulation.Computation(engine="python")).engine
        == "Python"
    )


def test_an_engine_that_is_none(loop):
    with pytest.raises(UnknownNameError, match="engine"):
        aj.simulate(*loop, 0.1, computation=aj.simulation.Computation(engine="gpu"))


@pytest.mark.study
def test_a_run_in_python_says_what_is_not_compiled(loop, two_link, monkeypatch):
    plant, law, target, q = loop
    noisy = aj.Plant(two_link, plant.sensor, actuator_delay=2e-3)

    def watch(loop):
        pass

    for changes, word in (
        ({"plant": noisy}, "delay"),
        ({"observer": watch}, "observer"),
    ):
        given = {"plant": plant, "controller": law, "target": target, "q0": q} | changes
        run = aj.simulate(**given, duration=6.0, record_every=0.1)
        assert run.engine.startswith("Python: ")
        assert word in run.engine
        assert word in str(run)
        with pytest.raises(InvalidInputError, match=word) as refused:
            aj.simulate(
                **given, duration=0.1, computation=aj.simulation.Computation(engine="compiled")
            )
        assert "engine" in str(refused.value)
    with pytest.raises(InvalidInputError, match="engine"):
        aj.simulate(*loop, 0.1, dt=None, computation=aj.simulation.Computation(engine="compiled"))
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "llvmlite" else found(name)
    )
    assert "approxjac[fast]" in aj.simulate(*loop, 6.0, record_every=1.0).engine


def test_what_was_changed_is_traced_again(loop):
    plant, law, target, q = loop
    first = aj.simulate(*loop, 0.5, computation=aj.simulation.Computation(engine="compiled"))
    own = aj.Plant(plant.robot, plant.sensor, friction=3.0)
    second = aj.simulate(
        own, law, target, q, 0.5, computation=aj.simulation.Computation(engine="compiled")
    )
    expected = aj.simulate(
        own, law, target, q, 0.5, computation=aj.simulation.Computation(engine="python")
    )
    np.testing.assert_allclose(second.q, expected.q, atol=1e-12)
    assert np.abs(second.q - first.q).max() > 1e-4


@pytest.mark.parametrize("drives", [None, Drives(rotor_inertia=0.1, stiffness=200.0)])
def test_motors_that_are_too_weak_are_compiled(loop, drives):
    plant, law, target, q = loop
    most = [0.9 * abs(plant.dynamics.g(q)[0]), np.inf]
    weak = aj.Plant(plant.robot, plant.sensor, torque_limits=most, drives=drives)
    python, ours = (
        aj.simulate(weak, law, target, q, 0.3, computation=Computation(engine=engine))
        for engine in ("python", "compiled")
    )
    assert (np.abs(python.tau[:, 0]) > most[0]).mean() > 0.2  # commands, which motors do not give
    assert ours.engine == "machine code"
    np.testing.assert_allclose(ours.q, python.q, atol=1e-10)
    strong = aj.Plant(plant.robot, plant.sensor, drives=drives)
    free = aj.simulate(strong, law, target, q, 0.3, computation=Computation(engine="compiled"))
    assert np.abs(free.q - ours.q).max() > 1e-3


def test_where_limits_do_without_the_proof_no_slack_is_known(loop):
    """Of machine code, too, whose steps answer with numbers; of torques that are free it is 0."""
    plant, law, target, q = loop
    weak = aj.Limits(effort=6.0 * np.abs(plant.dynamics.g(q)))
    low = aj.TorqueLimited(law, weak, proof=False, dt=3e-3)
    runs = [
        aj.simulate(plant, low, target, q, 0.6, dt=3e-3, computation=Computation(engine=engine))
        for engine in ("python", "compiled")
    ]
    slack, ours = (run.slack for run in runs)
    np.testing.assert_array_equal(ours, slack)
    assert 5 < np.isnan(slack).sum() < len(slack) - 5


def test_threads_run_the_same_loop_at_once(loop):
    plant, law, target, q = loop
    starts = [q + 0.01 * i for i in range(8)]

    def last(q0):
        return aj.simulate(
            plant, law, target, q0, 2.0, computation=aj.simulation.Computation(engine="compiled")
        ).q

    expected = [last(each) for each in starts]
    with ThreadPoolExecutor(4) as pool:
        for run, known in zip(pool.map(last, starts), expected, strict=True):
            np.testing.assert_array_equal(run, known)


def test_a_file_keeps_the_engine(loop, tmp_path):
    run = aj.simulate(*loop, 0.1, computation=aj.simulation.Computation(engine="compiled"))
    assert Trajectory.load(run.save(tmp_path / "run")).engine == "machine code"


@pytest.mark.study
def test_loops_that_are_kept_are_few(loop):
    plant, law, target, q = loop
    for dt in np.linspace(1e-3, 2e-3, whole_run._KEPT + 3):
        aj.simulate(
            plant,
            law,
            target,
            q,
            3 * dt,
            dt=dt,
            computation=aj.simulation.Computation(engine="compiled"),
        )
    assert len(whole_run._loops) <= whole_run._KEPT


@pytest.mark.parametrize("record_every", [1e-3, 5e-3])
def test_a_compiled_run_begins_with_the_velocity_of_its_start(record_every):
    robot = aj.load_robot("two_link")
    task, q0, v0 = aj.PositionTask(robot, axes="xz"), np.array([0.4, 0.9]), np.array([0.5, -0.8])
    plant, law = aj.Plant(robot, task), aj.SetpointController(task)
    target = task.value(q0 + 0.2)
    python, run = (
        aj.simulate(
            plant, law, target, InitialState(q0, v0), 0.1, record_every=record_every,
            computation=Computation(engine=engine),
        )
        for engine in ("python", "compiled")
    )  # fmt: skip
    np.testing.assert_array_equal(run.v[0], v0)
    for name in ("q", "v", "x", "tau", "error"):
        np.testing.assert_allclose(
            getattr(run, name), getattr(python, name), rtol=0, atol=1e-10, err_msg=name
        )


def test_a_compiled_run_that_diverges_is_the_error_of_python(two_link):
    task = aj.PositionTask(two_link, axes="xz")
    law = aj.SetpointController(task, aj.Gains(3e7, 4e5, 1.0))
    q, told = np.array([0.4, 0.9]), []
    for engine in ("python", "compiled"):
        with pytest.raises(SimulationError) as diverged:
            aj.simulate(
                aj.Plant(two_link, task), law, task.value(q) + 0.1, q, 0.4, dt=4e-3,
                computation=Computation("semi_implicit_euler", engine=engine),
            )  # fmt: skip
        told.append((type(diverged.value), str(diverged.value)))
    assert told[0] == told[1]


def test_an_observer_is_called_in_python_only(loop):
    with pytest.raises(InvalidInputError) as refused:
        aj.simulate(
            *loop, 0.1, observer=lambda loop: None, computation=Computation(engine="compiled")
        )
    assert refused.value.given == "compiled"


class Swings(OwnController):
    """A torque by the time of each sample."""

    def evaluate(self, state, measurement, target):
        torque = np.sin(3.0 * measurement.t + np.array([0.2, 1.1]))
        return aj.Evaluation(torque, state, aj.Status.OK, measurement.x - target)


@pytest.mark.parametrize("engine", ["python", "compiled"])
def test_a_law_knows_the_time_of_its_samples(two_link, engine):
    task = aj.PositionTask(two_link, axes="xz")
    run = aj.simulate(
        aj.Plant(two_link, task), Swings(task), (0.5, 1.2), (0.3, 0.8), 0.3, dt=3e-3,
        computation=Computation(engine=engine),
    )  # fmt: skip
    expected = np.sin(3.0 * run.t[:-1, np.newaxis] + [0.2, 1.1])
    np.testing.assert_allclose(run.tau[:-1], expected, atol=1e-12)


class Pushes(OwnController):
    """A torque beyond all reason, with which joints turn millions of times."""

    def evaluate(self, state, measurement, target):
        torque = 0.0 * measurement.q + np.array([1e8, 0.0])
        return aj.Evaluation(torque, state, aj.Status.OK, measurement.x - target)


def test_angles_of_which_code_has_no_sine_are_left_to_python(two_link):
    arm = two_link.with_gravity((0.0, 0.0, 0.0))
    task = aj.PositionTask(arm, axes="xz")
    python, run = (
        aj.simulate(
            aj.Plant(arm, task, joint_limits=False), Pushes(task), (0.5, 1.2), (0.3, 0.8), 0.006,
            dt=2e-3, computation=Computation("semi_implicit_euler", engine=engine),
        )
        for engine in ("python", "compiled")
    )  # fmt: skip
    assert 1e7 < np.abs(run.q).max() < 1e12
    assert run.engine.startswith("Python: ")
    np.testing.assert_array_equal(run.q, python.q)
