import copy
import dataclasses
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from own_controller import OwnController
from scipy.integrate import cumulative_simpson

import approxjac as aj
from approxjac.errors import (
    ControllerError,
    InvalidInputError,
    SimulationError,
    TrajectoryFileError,
    UnknownNameError,
)
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.simulation import Computation, InitialState
from approxjac.simulation.plant import INTEGRATORS, holdable


class ConstantTorque(OwnController):
    """The simplest thing with the interface of a controller."""

    def __init__(self, task, torque):
        super().__init__(task)
        self.torque = np.asarray(torque, dtype=float)

    def evaluate(self, state, measurement, target):
        e = measurement.x - target
        return aj.Evaluation(self.torque, state, aj.Status.OK, e)


def plant_of(robot, friction=0.0, **options):
    axes = "xz" if robot.nv == 2 else "xyz"
    return aj.Plant(robot, aj.PositionTask(robot, axes=axes), friction=friction, **options)


EXACT = Computation(rtol=1e-12, atol=1e-13)
PLANE = plant_of(aj.load_robot("two_link")).sensor


def released(robot, tau, duration, friction=0.0, computation=None, **options):
    """A run under a constant torque from a fixed start, as if there were no joint stops."""
    plant = plant_of(robot, friction, joint_limits=False)
    rng = np.random.default_rng(1)
    q0 = robot.random_configuration(rng)
    v0 = rng.uniform(-1, 1, robot.nv)
    options = {"dt": None, "q0": InitialState(q0, v0), "duration": duration, **options}
    if computation is not None:
        options["computation"] = computation
    controller = ConstantTorque(plant.sensor, tau)
    run = aj.simulate(plant, controller, np.zeros(plant.sensor.m), **options)
    return plant, run


@pytest.fixture(params=["two_link", "panda", "kinova"])
def robot(request):
    return aj.load_robot(request.param)


# -- integrators ----------------------------------------------------------------------------


@pytest.mark.parametrize(("integrator", "order"), [("rk4", 4), ("semi_implicit_euler", 1)])
def test_convergence_order_under_a_held_torque(robot, integrator, order):
    tau = 0.5 * np.ones(robot.nv)
    duration = 0.064 if robot.nv == 6 else 0.256
    _, reference = released(robot, tau, duration, computation=EXACT)
    errors = []
    for dt in (duration / 32, duration / 64):
        _, run = released(robot, tau, duration, dt=dt, computation=Computation(integrator))
        q_error = pin.difference(robot.model, reference.q[-1], run.q[-1])
        errors.append(np.linalg.norm(np.concatenate([q_error, run.v[-1] - reference.v[-1]])))
    measured = np.log2(errors[0] / errors[1])
    assert measured == pytest.approx(order, abs=0.3)


def test_the_continuous_error_follows_the_tolerance(robot):
    tau = np.zeros(robot.nv)
    _, reference = released(robot, tau, 0.3, computation=EXACT)
    errors = []
    for rtol in (1e-4, 1e-6, 1e-8):
        _, run = released(robot, tau, 0.3, computation=Computation(rtol=rtol, atol=rtol / 100))
        errors.append(np.abs(run.v[-1] - reference.v[-1]).max())
    assert errors[0] > 10 * errors[1] > 100 * errors[2]
    assert errors[2] < 1e-5 * np.abs(reference.v).max()


def test_a_sampled_run_converges_to_the_continuous_one():
    robot = aj.load_robot("two_link")
    controller = aj.SetpointController(
        aj.PositionTask(robot, axes="xz"),
        aj.Gains(60.0, 20.0),
        gravity=aj.AdaptiveGravity(GravityRegressor(robot, "x"), 0.1, 1.0, theta0=(0.0, 0.0)),
    )
    arguments = (plant_of(robot), controller, (0.5, 1.2), (0.3, 0.8), 1.0)
    exact = aj.simulate(*arguments, dt=None, record_every=0.1)
    errors = []
    for dt in (2e-3, 1e-3, 5e-4):
        run = aj.simulate(*arguments, dt=dt, record_every=0.1)
        assert_allclose(run.t, exact.t, atol=1e-12)
        errors.append(max(np.abs(run.q - exact.q).max(), np.abs(run.state - exact.state).max()))
    assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 1.0, atol=0.15)
    assert errors[-1] < 5e-3


# -- physics --------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"dt": 1e-4}])
def test_energy_is_conserved_without_torque_and_friction(robot, options):
    plant, run = released(robot, np.zeros(robot.nv), 0.2, **options)
    energy = [plant.dynamics.energy(q, v) for q, v in zip(run.q, run.v, strict=True)]
    rest = np.zeros(robot.nv)
    kinetic = np.array(energy) - [plant.dynamics.energy(q, rest) for q in run.q]
    assert_allclose(energy, energy[0], rtol=0, atol=1e-8 * kinetic.max())


def test_friction_dissipates_exactly_its_power():
    robot = aj.load_robot("two_link")
    B = np.array([0.3, 0.7])
    plant, run = released(robot, np.zeros(2), 2.0, friction=B, record_every=1e-3)
    energy = np.array([plant.dynamics.energy(q, v) for q, v in zip(run.q, run.v, strict=True)])
    lost = cumulative_simpson((run.v**2) @ B, x=run.t, initial=0.0)
    assert_allclose(energy[0] - energy, lost, atol=1e-6)


def test_a_robot_that_adds_its_own_gravity_stands_without_torque(two_link):
    told = two_link.with_object(0.1, 0.3, name="load")
    q, nothing = np.array([0.3, 0.9]), np.zeros(2)
    for robot in (told, two_link):
        plant = aj.Plant(robot, adds_gravity=told)
        torque = plant.dynamics.g(q) - aj.robots.Dynamics(told).g(q)
        assert_allclose(plant.holding_torque(q), torque, atol=1e-12)
        assert_allclose(plant.acceleration(q, nothing, torque), 0.0, atol=1e-9)
        stands = plant.advance(q, nothing, torque, 0.01, INTEGRATORS["rk4"])[0]
        assert_allclose(stands, q, atol=1e-3)
    assert np.abs(plant.acceleration(q, nothing, nothing)).max() > 0.5  # told of too much
    weak = aj.Plant(told, adds_gravity=told, torque_limits=1.0)  # motors carry what it adds, too
    assert np.abs(weak.acceleration(q, nothing, nothing)).max() > 1.0
    assert "adds_gravity" in repr(copy.deepcopy(plant))
    for what in (plant.require_ideal, partial(plant.require_ideal, late=True)):
        with pytest.raises(InvalidInputError, match="gravity that it adds"):
            what("a test")
    with pytest.raises(InvalidInputError, match="adds_gravity must be of a robot with the joi"):
        aj.Plant(two_link, adds_gravity=aj.load_robot("panda"))


@pytest.mark.parametrize("kind", [aj.Plant, aj.MujocoPlant])
def test_gravity_that_a_robot_adds_is_as_if_it_were_sent(panda, kind):
    told = panda.with_object(0.1, 0.5)
    adds, plain = kind(panda, adds_gravity=told, friction=0.3), kind(panda, friction=0.3)
    own, rng = aj.robots.Dynamics(told), np.random.default_rng(0)
    least, most = panda.position_limits
    for at_stop in (False, True):
        q = least + rng.uniform(0.2, 0.8, 7) * (most - least)
        q[3] = most[3] + 0.01 if at_stop else q[3]
        v, tau = rng.normal(size=(2, 7))
        given = adds.advance(q, v, tau, 1e-3, INTEGRATORS["rk4"])[:2]
        same = plain.advance(q, v, tau + own.g(q), 1e-3, INTEGRATORS["rk4"])[:2]
        assert_allclose(np.concatenate(given), np.concatenate(same), rtol=0, atol=1e-12)


@pytest.mark.parametrize("late", [{"dt": None}, {"actuator_delay": 4e-3}])
def test_a_robot_that_adds_gravity_is_led_without_gravity(panda, late):
    timing = {"dt": late.get("dt", 1e-3)}
    plant = aj.Plant(panda, adds_gravity=panda, actuator_delay=late.get("actuator_delay", 0.0))
    task = aj.PositionTask(panda.with_object(0.0))
    law = aj.SetpointController(task, gravity=aj.NoGravity(task.robot))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    run = aj.simulate(plant, law, task.value(q0) + 0.05, q0, 2.0, **timing)
    assert run.error_norm[-1] < 1e-3


def test_a_run_starts_where_the_limited_motors_of_the_plant_hold_the_arm(panda):
    """Not where those of the URDF would, which are stronger."""
    usual = aj.Plant(panda)
    load = np.abs(usual.dynamics.g(usual.ready_configuration()))
    limits = np.where(load == load.max(), load, panda.effort_limits)
    plant = aj.Plant(panda, torque_limits=limits)
    share = np.abs(plant.dynamics.g(plant.ready_configuration())) / limits
    assert share.max() <= 0.7 + 1e-12


def test_gravity_direction_is_the_plants():
    robot = aj.load_robot("two_link")
    q0 = np.array([0.3, 0.4])
    still = plant_of(robot.with_gravity((0.0, 0.0, 0.0)))
    run = aj.simulate(still, ConstantTorque(still.sensor, (0.0, 0.0)), (0.0, 0.0), q0, 0.5, dt=None)
    assert_allclose(run.q, np.tile(q0, (len(run.t), 1)), atol=1e-12)
    sideways = plant_of(robot.with_gravity((0.0, -9.81, 0.0)))  # across the arm's plane
    run = aj.simulate(sideways, ConstantTorque(PLANE, (0.0, 0.0)), (0.0, 0.0), q0, 0.5, dt=None)
    assert_allclose(run.q[-1], q0, atol=1e-12)


def test_continuous_joints_stay_on_the_circle():
    robot = aj.load_robot("kinova")
    _, run = released(robot, 2.0 * np.ones(6), 0.5)
    assert run.q.shape[1] == 9
    assert all(pin.isNormalized(robot.model, q, 1e-9) for q in run.q)


def test_the_paper_law_reaches_the_target_on_a_panda_with_an_unknown_tool(panda):
    """THEORY.md, section 6: 24 cm of error with a 20 cm tool believed absent."""
    truth, belief = panda.with_object(0.20, 0.0), panda.with_object(0.0, 0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    controller = aj.SetpointController(aj.PositionTask(belief), aj.Gains(400.0, 80.0, 1.0))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    target = plant.sensor.value(q0) + [0.1, -0.15, 0.16]
    run = aj.simulate(plant, controller, target, q0, 5.0, dt=1e-3)
    assert run.error_norm[0] == pytest.approx(0.24, abs=0.01)
    assert run.error_norm[-1] < 1e-6


# -- records --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def short_run():
    robot = aj.load_robot("two_link")
    controller = aj.SetpointController(aj.PositionTask(robot, axes="xz"), aj.Gains(60.0, 20.0))
    return aj.simulate(plant_of(robot), controller, (0.5, 1.2), (0.3, 0.8), 0.1, dt=0.01)


def test_the_record_holds_the_run(short_run):
    run = short_run
    assert_allclose(run.t, np.linspace(0, 0.1, 11))
    assert run.q.shape == run.v.shape == run.tau.shape == run.x.shape == run.error.shape == (11, 2)
    assert_allclose(run.error, run.x - run.target)
    assert run.state.shape == (11, 0)
    assert run.status_counts() == {aj.Status.OK: 11}
    assert run.units["tau"] == "N m"
    assert run.units["x"] == run.task_unit == "m"
    assert_allclose(run.error_norm, np.hypot(*run.error.T))
    assert repr(run) == "Trajectory('two_link', 0.1 s, 11 samples; |e| 0.909 -> 0.731 m)"


def test_a_run_saves_and_loads(short_run, tmp_path):
    path = short_run.save(tmp_path / "run")
    assert path.name == "run.npz"
    loaded = aj.Trajectory.load(path)
    for name in ("t", "q", "v", "x", "error", "tau", "state", "status", "target"):
        assert np.array_equal(getattr(loaded, name), getattr(short_run, name), equal_nan=True)
    assert loaded.joint_names == short_run.joint_names
    assert loaded.joint_units == ("rad", "rad")
    assert loaded.task_labels == short_run.task_labels
    assert repr(loaded) == repr(short_run)
    with np.load(path) as file:
        assert_allclose(file["q"], short_run.q)


def test_files_that_are_no_runs_are_refused(tmp_path):
    with pytest.raises(TrajectoryFileError, match=r"run\.npz does not exist"):
        aj.Trajectory.load(tmp_path / "run.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(TrajectoryFileError, match=r"text.npz is not a trajectory written by"):
        aj.Trajectory.load(tmp_path / "text.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(TrajectoryFileError, match=r"empty.npz is not a trajectory written by"):
        aj.Trajectory.load(tmp_path / "empty.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(TrajectoryFileError, match=r"other.npz is not a trajectory written by"):
        aj.Trajectory.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("error", np.zeros((3, 2))),
        ("q", np.zeros(11)),
        ("status", np.full(11, 99)),
        ("t", np.zeros(11)),
        ("joint_units", ("rad",)),
        ("robot_name", 5),
    ],
)
def test_files_whose_arrays_do_not_fit_are_refused(short_run, tmp_path, name, value):
    read = aj.Trajectory.load(short_run.save(tmp_path / "good.npz"))
    path = dataclasses.replace(read, **{name: value}).save(tmp_path / "bad.npz")
    with pytest.raises(TrajectoryFileError, match=r"bad.npz is not a trajectory written by"):
        aj.Trajectory.load(path)


def test_endings_are_added_where_they_are_missing(short_run, tmp_path):
    assert short_run.save(tmp_path / "run.NPZ").name == "run.NPZ"
    short_run.save(tmp_path / "other")
    assert repr(aj.Trajectory.load(tmp_path / "other")) == repr(short_run)
    assert repr(aj.Trajectory.load(tmp_path / "run.NPZ")) == repr(short_run)
    with pytest.raises(aj.InvalidInputError, match="path must name a file, got"):
        short_run.save("")


def test_a_run_that_cannot_be_written_is_a_named_error(short_run, tmp_path):
    with pytest.raises(TrajectoryFileError, match="path must be a file that can be written"):
        short_run.save(tmp_path / "nowhere" / "run.npz")


def test_prismatic_joints_have_their_own_units(short_run):
    mixed = dataclasses.replace(short_run, joint_units=("m", "rad"))
    assert mixed.units["tau"] == "N m or N"
    assert mixed.units["v"] == "rad/s or m/s"


def test_records_can_be_thinned(short_run):
    robot = aj.load_robot("two_link")
    controller = aj.SetpointController(aj.PositionTask(robot, axes="xz"), aj.Gains(60.0, 20.0))
    arguments = (plant_of(robot), controller, (0.5, 1.2), (0.3, 0.8), 0.1)
    thin = aj.simulate(*arguments, dt=0.01, record_every=0.03)
    assert_allclose(thin.t, [0.0, 0.03, 0.06, 0.09, 0.1])
    assert_allclose(thin.q, short_run.q[[0, 3, 6, 9, 10]])
    seen = []
    run = aj.simulate(
        *arguments,
        dt=None,
        record_every=0.025,
        computation=aj.simulation.Computation(progress=seen.append),
    )
    assert_allclose(run.t, [0.0, 0.025, 0.05, 0.075, 0.1])
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(0.1)


# -- bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"target": (1.0,)}, aj.InvalidInputError, r"target must have shape \(2,\) \[m\], got sha"),
        ({"target": (np.nan, 1.0)}, aj.InvalidInputError, r"target must be finite \[m\], got"),
        (
            {"q0": (1.0,)},
            aj.InvalidInputError,
            r"q0 must have shape \(2,\) \[rad or m\], got shape",
        ),
        ({"q0": (np.nan, 0.0)}, aj.InvalidInputError, r"q0 must be finite \[rad or m\], got \[nan"),
        (
            {"q0": InitialState(v0=(1.0, np.inf))},
            aj.InvalidInputError,
            r"v0 must be finite \[rad/s\], got",
        ),
        ({"duration": 0.0}, aj.InvalidInputError, r"duration must be a finite number > 0 \[s\]"),
        ({"dt": -1.0}, aj.InvalidInputError, r"dt must be a finite number > 0 \[s\], got -1.0"),
        (
            {"dt": 0.3},
            aj.InvalidInputError,
            r"duration must be a whole number of dt = 0.3 \[s\], got",
        ),
        (
            {"dt": 0.1, "record_every": 0.25},
            aj.InvalidInputError,
            r"record_every must be a whole number of dt = 0.1 \[s\], got 0.25",
        ),
        (
            {"record_every": 0.3},
            aj.InvalidInputError,
            r"duration must be a whole number of record_every = 0.3 \[s\], got 1",
        ),
        ({"record_every": 0.0}, aj.InvalidInputError, r"record_every must be a finite number > 0"),
    ],
)
def test_bad_arguments_are_refused(changes, error, text):
    robot = aj.load_robot("two_link")
    arguments = {"target": (0.5, 1.2), "q0": (0.3, 0.8), "duration": 1.0, "dt": None, **changes}
    with pytest.raises(error, match=text):
        aj.simulate(plant_of(robot), ConstantTorque(PLANE, (0.0, 0.0)), **arguments)


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"rtol": 0.0}, aj.InvalidInputError, r"rtol must be a finite number > 0, got 0.0"),
        ({"atol": -1.0}, aj.InvalidInputError, r"atol must be a finite number > 0, got -1.0"),
        (
            {"integrator": "rk5"},
            UnknownNameError,
            "integrator 'rk5' not in the integrators; did you mean 'rk4'",
        ),
    ],
)
def test_a_computation_that_is_none(given, error, text):
    with pytest.raises(error, match=text):
        Computation(**given)


def test_a_configuration_off_the_circle_is_refused():
    robot = aj.load_robot("kinova")
    with pytest.raises(aj.InvalidInputError, match=r"q0 must have cos\^2 \+ sin\^2 = 1"):
        released(robot, np.zeros(6), 1.0, q0=np.zeros(9))


def test_a_sensor_of_another_robot_is_refused(two_link, panda):
    with pytest.raises(aj.InvalidInputError, match="sensor must be a task of the plant's own rob"):
        aj.Plant(two_link, aj.PositionTask(panda))
    with pytest.raises(aj.InvalidInputError, match=r"friction must be >= 0 in every entry \[N m s"):
        aj.Plant(panda, aj.PositionTask(panda), friction=-1.0)


class Explosive(ConstantTorque):
    """Torque that grows with the square of the velocity: the motion has a pole in time."""

    def evaluate(self, state, measurement, target):
        answer = super().evaluate(state, measurement, target)
        return answer._replace(torque=1e3 * np.sign(measurement.v) * measurement.v**2)


@pytest.mark.parametrize(
    ("dt", "text"),
    [
        (None, r"the integration stopped at t = .* of 100 s: the steps have become vanishingly"),
        (
            1e-3,
            r"the simulation diverged at t = .* of 100 s: .* \(a smaller dt or smaller gains may",
        ),
    ],
)
def test_a_run_that_explodes_is_a_named_error(dt, text):
    plant = plant_of(aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0)))
    with pytest.raises(SimulationError, match=text):
        aj.simulate(
            plant,
            Explosive(PLANE, (0.0, 0.0)),
            (0.0, 0.0),
            aj.simulation.InitialState((0.3, 0.8), v0=(1.0, 1.0)),
            100.0,
            dt=dt,
        )


@pytest.mark.parametrize("dt", [pytest.param(None, marks=pytest.mark.study), 0.05])
def test_a_loop_that_is_too_stiff_is_a_named_error_not_a_blame(dt):
    """The user's input is fine; it is the sampled loop, or the law itself, that diverges."""
    robot = aj.load_robot("ur5")
    task = aj.PositionTask(robot)
    gains = aj.Gains(400.0, 80.0, 1.0) if dt else aj.Gains(1e60, 1e-60, 1e-60)
    controller = aj.SetpointController(task, gains)
    plant = aj.Plant(robot, task)
    q0 = np.array([0.0, -1.0, 1.5, -1.0, -1.5, 0.0])
    target = task.value(q0) + [0.1, 0.1, 0.1]
    with pytest.raises(SimulationError, match=r"the (simulation|integration) .* at t = "):
        aj.simulate(plant, controller, target, q0, 5.0, dt=dt)


def test_wrong_shapes_between_plant_and_controller_are_no_divergence(panda):
    plant = aj.Plant(panda, aj.PositionTask(panda, axes="xy"))
    controller = aj.SetpointController(aj.PositionTask(panda), aj.Gains(1.0, 1.0, 1.0))
    for dt in (None, 1e-3):
        with pytest.raises(
            aj.InvalidInputError, match="must have the coordinates of the plant's s"
        ):
            aj.simulate(plant, controller, (0.5, 0.0), np.zeros(7), 1.0, dt=dt)


class Faulty(ConstantTorque):
    """A controller that answers something else than it should."""

    def __init__(self, **changes):
        super().__init__(PLANE, (0.0, 0.0))
        self.changes = changes

    def evaluate(self, state, measurement, target):
        return super().evaluate(state, measurement, target)._replace(**self.changes)


class Wordless(Faulty):
    """A law that answers with a torque alone."""

    def evaluate(self, state, measurement, target):
        return super().evaluate(state, measurement, target).torque


class Stateless(Faulty):
    """A controller that steps into something that is no array."""

    def advance(self, state, measurement, target, dt):
        return (), self.evaluate(state, measurement, target)


class Late(ConstantTorque):
    """A controller whose step goes wrong at 50 ms."""

    def __init__(self, step):
        super().__init__(PLANE, (0.0, 0.0))
        self.late = step

    def advance(self, state, measurement, target, dt):
        after, answer = state, self.evaluate(state, measurement, target)
        return (after, answer) if measurement.t < 0.05 else self.late(after, answer)

    def __repr__(self):
        return "Late()"


def fails():
    raise LookupError("no such gain")


@pytest.mark.parametrize(
    ("late", "text"),
    [
        (
            lambda s, a: (s, a._replace(torque=np.zeros(3))),
            r"torque must have shape \(2,\), got sha",
        ),
        (lambda s, a: (s, a._replace(torque=[0, 0])), r"torque must be an array, got \[0, 0\]"),
        (
            lambda s, a: (s, a._replace(torque=a.torque * np.nan)),
            r"torque must be finite, got \[nan",
        ),
        (lambda s, a: (np.zeros(1), a), r"state must have shape \(0,\), got shape \(1,\)"),
        (lambda s, a: None, r"must return \(state, Evaluation\), got None"),
        (lambda s, a: fails(), "LookupError: no such gain"),
        (lambda s, a: aj.load_robot(3), "source must be .*, got 3"),
    ],
)
def test_a_step_that_goes_wrong_in_a_run_is_named_with_the_time(late, text):
    """And is no divergence."""
    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(ControllerError, match=rf"step of Late\(\) failed at t = 0.05 s: .*{text}"):
        aj.simulate(plant, Late(late), (0.5, 1.2), (0.3, 0.8), 0.1, dt=0.01)


@pytest.mark.parametrize(
    ("late", "text"),
    [
        (lambda a: a._replace(torque=np.zeros(3)), r"got \(\(3,\), \(0,\)\) at t = 0\.0[56]"),
        (lambda a: fails(), r"failed at t = 0\.0[56]\d* s: LookupError: no such gain"),
    ],
)
def test_an_evaluation_that_goes_wrong_in_continuous_time_is_named_too(late, text):
    class Own(Faulty):
        def evaluate(self, state, measurement, target):
            answer = super().evaluate(state, measurement, target)
            return late(answer) if measurement.t > 0.05 else answer

    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(ControllerError, match=rf"evaluate of .*Own.* {text}"):
        aj.simulate(plant, Own(), (0.5, 1.2), (0.3, 0.8), 0.1, dt=None)


def test_a_step_has_to_return_an_array():
    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(aj.InvalidInputError, match=r"the controller's state must be an array"):
        aj.simulate(plant, Stateless(), (0.5, 1.2), (0.3, 0.8), 1.0, dt=0.1)


def test_a_class_is_no_path():
    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(aj.InvalidInputError, match=r"must be numbers of shape \(2,\)"):
        aj.simulate(plant, Faulty(), aj.Circle, (0.3, 0.8), 1.0, dt=0.1)


@pytest.mark.parametrize("dt", [None, 0.1])
@pytest.mark.parametrize(
    ("controller", "text"),
    [
        (None, "controller must be a controller, such as SetpointController"),
        (ConstantTorque, "controller must be a controller, such as SetpointController"),
        (Faulty(torque=np.zeros(3)), r"the controller's torque must have shape \(2,\)"),
        (Faulty(torque=np.full(2, np.nan)), r"the controller's torque must be finite"),
        (Faulty(state_rate=np.zeros(1)), r"the controller's state_rate must have shape \(0,\)"),
        (Faulty(state_rate=None), r"evaluate must return an Evaluation with a state_rate, got Eva"),
        (Faulty(e=np.zeros(1)), r"the controller's e must have shape \(2,\)"),
        (Wordless(), r"evaluate must return an Evaluation with a state_rate, got array"),
    ],
)
def test_faulty_controllers_are_named(controller, text, dt):
    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.simulate(plant, controller, (0.5, 1.2), (0.3, 0.8), 1.0, dt=dt)


def test_a_controller_may_use_one_buffer_for_all_torques():
    class Counting(ConstantTorque):
        def evaluate(self, state, measurement, target):
            self.torque[:] = measurement.t
            return super().evaluate(state, measurement, target)

    plant = plant_of(aj.load_robot("two_link"))
    run = aj.simulate(plant, Counting(PLANE, (0.0, 0.0)), (0.5, 1.2), (0.3, 0.8), 0.5, dt=0.1)
    assert_allclose(run.tau[:, 0], run.t)


def test_axes_in_another_order_are_refused():
    robot = aj.load_robot("two_link")
    controller = aj.SetpointController(aj.PositionTask(robot, axes="zx"), aj.Gains(1.0, 1.0))
    with pytest.raises(aj.InvalidInputError, match="must have the coordinates of the plant's sen"):
        aj.simulate(plant_of(robot), controller, (0.5, 1.2), (0.3, 0.8), 1.0, dt=0.1)


@pytest.mark.parametrize("changes", [{"dt": 1e-320}, {"record_every": 1e-30}])
def test_absurdly_many_steps_are_refused(changes):
    plant = plant_of(aj.load_robot("two_link"))
    with pytest.raises(aj.InvalidInputError, match="must be at least 1e-9 of duration = 1"):
        aj.simulate(
            plant,
            ConstantTorque(PLANE, (0.0, 0.0)),
            (0.5, 1.2),
            (0.3, 0.8),
            1.0,
            **{"dt": None, **changes},
        )


def test_damaged_files_are_always_a_named_error(short_run, tmp_path):
    path = short_run.save(tmp_path / "run.npz")
    data = path.read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(200):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            aj.Trajectory.load(path)
        except TrajectoryFileError:
            refused += 1
    assert refused > 150


@pytest.mark.parametrize("side", [0.0, np.pi])
def test_a_configuration_is_held_well_if_no_motor_takes_more_than_seven_tenths(two_link, side):
    """To either side: stretched out to the left the torques are those of the right, turned."""
    dynamics, q = Dynamics(two_link), np.array([side, 0.0])
    g = np.abs(dynamics.g(q))
    assert g.min() > 1.0
    for i in range(2):
        effort = np.full(2, 1e3)
        effort[i] = g[i] / 0.69
        assert holdable(dynamics, q, effort)
        effort[i] = g[i] / 0.71
        assert not holdable(dynamics, q, effort)


@pytest.mark.parametrize("name", ["ur5", "kinova"])
def test_gravity_that_a_robot_adds_is_that_of_the_arm_it_knows(name, rng):
    """At rest it needs the difference of both gravity torques, and nothing more."""
    arm = aj.load_robot(name)
    truth, known = arm.with_object(0.2, 1.9), arm.with_object(0.1, 0.7)
    plant = aj.Plant(truth, aj.PositionTask(truth), adds_gravity=known)
    for q in truth.configurations(3):
        rest = Dynamics(truth).g(q).copy() - Dynamics(known).g(q)
        assert np.abs(rest).max() > 0.5
        a = plant.acceleration(q, np.zeros(truth.nv), rest)
        assert_allclose(Dynamics(truth).M(q) @ a, 0.0, atol=1e-10)
