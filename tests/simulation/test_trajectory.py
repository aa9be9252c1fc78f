"""What a run records of the law, V and the scene, and what a file keeps of them."""

import dataclasses
import json

import numpy as np
import pytest
from lyapunov_decrease import lyapunov
from numpy.testing import assert_allclose, assert_array_equal
from own_controller import OwnController
from rehearsal import Around

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import Controller, DifferentiatedVelocity
from approxjac.errors import TrajectoryFileError
from approxjac.robots import GravityRegressor
from approxjac.simulation import Condition, VelocityServo
from approxjac.tasks import CombinedTask, NonsingularTask
from approxjac.tasks.analysis import features

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
GAINS = aj.Gains(kp=[300.0, 400.0, 500.0], kv=80.0, damping=1.5)


def belief_of(panda):
    return panda.with_object(0.05, 0.0, axis="x")


def reach(panda, controller_of, *, dt=1e-3, axes="xyz"):
    truth = panda.with_object(0.2, 0.5, axis="x")
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes))
    controller = controller_of(aj.PositionTask(belief_of(panda), axes=axes))
    target = plant.sensor.value(START) + 0.05
    run = aj.simulate(plant, controller, target, START, 0.05, dt=dt, record_every=0.005)
    return plant, controller, run


def setpoint(task, **options):
    regressor = GravityRegressor(task.robot)
    options = {"gravity": aj.AdaptiveGravity(regressor, L=0.5, alpha=2.0), **options}
    return aj.SetpointController(task, GAINS, **options)


def test_the_task_torque_is_the_law_without_damping_and_gravity(panda):
    _, controller, run = reach(panda, setpoint)
    task = controller.task
    Z = controller.adaptation.regressor
    for k in range(len(run.t)):
        rest = -1.5 * run.v[k] + Z.Z(run.q[k]) @ run.state[k]
        assert_allclose(run.task_torque[k], run.tau[k] - rest, atol=1e-9)
        J_hat = task.jacobian(run.q[k])
        F = np.array([300.0, 400.0, 500.0]) * run.error[k] + 80.0 * J_hat @ run.v[k]
        assert_allclose(run.task_torque[k], -J_hat.T @ F, atol=1e-9)


def test_the_task_torque_of_law_5_has_the_measured_velocity(panda):
    def controller_of(task):
        return setpoint(task, gravity=aj.NoGravity(task.robot), velocity=DifferentiatedVelocity())

    _, _, run = reach(panda, controller_of)
    assert_allclose(run.task_torque, run.tau + 1.5 * run.v, atol=1e-9)


def test_some_instants_are_those_of_all(panda, tmp_path):
    run = reach(panda, setpoint)[-1]
    for name in ("V", "task_torque"):
        some = run.at(name, [7, -1])
        assert name not in vars(run)
        assert_array_equal(some, getattr(run, name)[[7, -1]])
        assert_array_equal(some, run.at(name, [7, -1]))
    loaded = aj.Trajectory.load(run.save(tmp_path / "run.npz"))
    for name in ("V", "task_torque"):
        assert_array_equal(loaded.at(name, [7, -1]), run.at(name, [7, -1]))


def test_limiters_show_the_torque_that_the_law_wants(panda):
    limits = aj.Limits(effort=10.0)
    _, _, free = reach(panda, setpoint)
    for proof in (False, True):
        _, _, run = reach(
            panda, lambda task, p=proof: aj.TorqueLimited(setpoint(task), limits, proof=p)
        )
        assert_allclose(run.task_torque[0], free.task_torque[0])
        assert np.abs(run.tau).max() <= 10.0 < np.abs(free.tau).max()
        assert_allclose(run.V[0], free.V[0])


def test_laws_without_a_task_force_or_V_have_none(panda):
    class Nothing(OwnController):
        def evaluate(self, state, measurement, target):
            e = measurement.x - target
            return aj.Evaluation(np.zeros(7), np.zeros(0), aj.Status.OK, e)

    _, _, run = reach(panda, Nothing)
    assert np.isnan(run.task_torque).all()
    assert np.isnan(run.V).all()


def test_a_wrapper_of_ones_own_may_have_any_state(panda):
    """What it records of V, it would have to know whose state comes first."""

    class Own(OwnController):
        def __init__(self, task):
            super().__init__(task)
            self.controller = setpoint(task)

        def begin(self, measurement):
            return np.append(7.0, self.controller.begin(measurement))

        def evaluate(self, state, measurement, target):
            answer = self.controller.evaluate(state[1:], measurement, target)
            return answer._replace(state_rate=np.append(0.0, answer.state_rate))

    _, _, run = reach(panda, Own)
    assert np.isnan(run.V).all()
    assert np.isnan(run.task_torque).all()


@pytest.mark.parametrize("wrapped", ["limited", "held"])
def test_V_of_a_law_that_is_limited_or_held_is_its_own(panda, wrapped):
    def limited(task):
        return aj.TorqueLimited(setpoint(task), aj.Limits(effort=60.0, rate=3000.0))

    kinds = {"limited": limited, "held": lambda task: aj.HeldMeasurement(limited(task), 0.3)}
    plant, controller, run = reach(panda, kinds[wrapped])
    law_ = controller.law
    theta = law_.adaptation.regressor.fit(plant.robot)[0]
    for k in (0, 5, 10):
        V, _ = lyapunov(
            plant, law_, run.q[k], run.v[k], run.target, law_.alpha,
            state=run.state[k][: len(law_.adaptation.theta0)], theta=theta,
        )  # fmt: skip
        assert_allclose(run.V[k], V, rtol=1e-9)


@pytest.mark.parametrize("learnt", [True, False])
def test_V_is_that_of_the_analysis(panda, learnt):
    """The record's V against `lyapunov`, which refuses what it is not for."""
    options = {} if learnt else {"gravity": None}
    plant, controller, run = reach(panda, lambda task: setpoint(task, **options), dt=None)
    theta = controller.adaptation.regressor.fit(plant.robot)[0] if learnt else None
    for k in (0, 4, 10):
        state = run.state[k] if learnt else None
        V, _ = lyapunov(
            plant, controller, run.q[k], run.v[k], run.target, controller.alpha,
            state=state, theta=theta,
        )  # fmt: skip
        assert_allclose(run.V[k], V, rtol=1e-9)
    assert run.V[0] > run.V[-1] > 0.0


def test_V_at_a_singular_pose_is_finite():
    arm = aj.load_robot("two_link")
    task, q = aj.PositionTask(arm, axes="xz"), np.zeros(2)
    run = aj.simulate(
        aj.Plant(arm, task), aj.SetpointController(task), [1.0, 1.0], q, 0.01, dt=None
    )
    assert np.linalg.svd(task.jacobian(q), compute_uv=False)[-1] < 1e-6
    assert np.isfinite(run.V).all()


def test_it_says_from_when_on_the_error_is_below_a_hundredth(panda):
    """From the instant after the last above it on; and nothing if it ends above."""
    _, _, run = reach(panda, setpoint)
    sizes = np.array([1.0, 0.5, 0.02, 0.009, 0.011, 0.01, 0.005, 0.004, 0.003, 0.002, 0.001])
    error = np.outer(sizes, [0.0, 3.0, 4.0])
    assert len(run.t) == len(sizes)
    text = str(dataclasses.replace(run, error=error))
    assert "error 5 -> 0.005 m, below 1 % of the start from 0.025 s on" in text
    text = str(dataclasses.replace(run, error=error[::-1]))
    assert "error 0.005 -> 5 m" in text
    assert "below" not in text


class Swinging(Controller):
    """A controller that leads the first joint, and lets it swing about that."""

    command = "velocity"

    def __init__(self, task, led, swing):
        super().__init__(task)
        self.led, self.swing = led, swing

    def advance(self, state, measurement, target, dt):
        velocity = np.zeros(self.task.robot.nv)
        velocity[0] = self.led + self.swing * np.cos(10.0 * np.pi * measurement.t)
        e = self.task.error(measurement.x, target.x)
        J_hat = self.task.jacobian(measurement.q, measurement.x)
        return state, aj.Evaluation(velocity, None, aj.Status.OK, e, J_hat)


class Led:
    """A target that is led by the first joint at a constant speed."""

    def __init__(self, task, q, speed):
        self.task, self.q, self.v = task, q, speed * np.eye(len(q))[0]

    def at(self, t):
        q = self.q + t * self.v
        return aj.Target(self.task.value(q), self.task.jacobian(q) @ self.v)


@pytest.mark.parametrize("every", [1e-3, 4e-3])
def test_what_swings_while_it_is_led_is_an_event_however_often_it_is_recorded(two_link, every):
    """By the speed of the target, which is the same from one recorded instant to the next."""
    servo = VelocityServo(lag=2e-3, delay=0.0, period=1e-3)
    task, q = aj.PositionTask(two_link, axes="xz"), np.array([-0.9, 1.2])
    plant = aj.Plant(two_link, task, servo=servo, joint_limits=False)
    for swing, named in ((0.3, True), (0.0, False)):
        run = aj.simulate(
            plant, Swinging(task, 0.15, swing), Led(task, q, 0.15), q, 2.0, dt=1e-3,
            record_every=every,
        )  # fmt: skip
        conditions = {event.condition for event in run.events}
        assert conditions == ({Condition.OSCILLATES} if named else set())


def test_a_file_keeps_the_scene(panda, tmp_path):
    _, _, run = reach(panda, setpoint, axes="xzy")
    again = aj.Trajectory.load(run.save(tmp_path / "run"))
    for field in dataclasses.fields(run):
        if field.name not in ("scene", "derived"):
            assert_array_equal(getattr(run, field.name), getattr(again, field.name))
    for name in ("V", "task_torque"):
        assert_array_equal(getattr(run, name), getattr(again, name))
    assert again.scene.to_dict() == run.scene.to_dict()
    assert again.scene.truth == run.scene.truth
    assert again.scene.belief == run.scene.belief != run.scene.truth
    assert_array_equal(again.scene.sensor.value(run.q[-1]), run.x[-1])
    assert_array_equal(again.scene.torque_limits, run.scene.truth.effort_limits)


CAMERA = aj.PinholeCamera.looking_at(
    (0.4, 0.0, 0.5), (1.5, -0.8, 0.9), 600.0, (640, 480), distortion=(0.02, -0.01)
)
MOUNTED = aj.PinholeCamera(500.0, (640, 480), mount="panda_hand")


@pytest.mark.parametrize(
    "task_of",
    [
        aj.PoseTask,
        lambda robot: aj.ImageTask(robot, CAMERA),
        lambda robot: aj.ImageTask(
            robot, CAMERA, points=[(0, 0, 0), (0.05, 0, 0)], depth="measured"
        ),
        lambda robot: aj.ImageTask(robot, MOUNTED, None, [(0.6, 0.0, 0.1)], depth=[0.4]),
        lambda robot: aj.ImageTask(robot, PlanarCamera(0.05, 3.0, roll=0.2)),
        lambda robot: aj.StackedTask(aj.PositionTask(robot, axes="z"), aj.ImageTask(robot, CAMERA)),
        lambda robot: CombinedTask(aj.ImageTask(robot, CAMERA), np.eye(2)),
        lambda robot: NonsingularTask(aj.PositionTask(robot), {"panda_joint4": 0.3}),
    ],
)
def test_every_kind_of_task_is_kept(panda, task_of, tmp_path):
    truth, belief = panda.with_object(0.2, 0.5), panda.with_object(0.0)
    sensor, task = task_of(truth).measured, task_of(belief)
    controller = aj.SetpointController(task)
    x_d = sensor.value(START)
    run = aj.simulate(aj.Plant(truth, sensor), controller, x_d, START, 0.002, dt=1e-3)
    again = aj.Trajectory.load(run.save(tmp_path / "run"))
    for kept, given in ((again.scene.sensor, sensor), (again.scene.task, task)):
        assert_allclose(kept.value(START), given.value(START), rtol=1e-13)
        assert kept.measured.labels == given.measured.labels
        for a, b in zip(features(kept), features(given), strict=True):
            assert (a.entries, a.frame, a.axes) == (b.entries, b.frame, b.axes)
            assert type(a.camera) is type(b.camera)
            assert_array_equal(a.points, b.points)
            assert len(given.value(START)[a.entries]) == a.entries.stop - a.entries.start


def test_a_task_of_ones_own_leaves_the_robots(panda, tmp_path):
    class Height(aj.PositionTask):
        def value(self, q):
            return super().value(q) + 0.1

    task = Height(panda)
    x_d = task.value(START)
    run = aj.simulate(
        aj.Plant(panda, task), aj.SetpointController(task), x_d, START, 0.002, dt=1e-3
    )
    again = aj.Trajectory.load(run.save(tmp_path / "run"))
    assert again.scene.sensor is again.scene.task is None
    assert again.scene.truth == again.scene.belief == panda


def test_a_damaged_scene_is_a_named_error(panda, tmp_path):
    _, _, run = reach(panda, setpoint)
    path = run.save(tmp_path / "run")
    with np.load(path) as file:
        arrays = dict(file)
    texts = json.loads(str(arrays.pop("texts")))
    for change in (
        {"truth": 3},
        {"truth": {**texts["scene"]["truth"], "urdf": "<robot/>"}},
        {"sensor": {"kind": "dance"}},
        {"sensor": {"kind": "position", "frame": "nowhere", "axes": "xyz"}},
        {"torque_limits": [1.0]},
    ):
        broken = {**texts, "scene": {**texts["scene"], **change}}
        np.savez(path, texts=np.array(json.dumps(broken)), **arrays)
        with pytest.raises(TrajectoryFileError, match="is not a trajectory written by"):
            aj.Trajectory.load(path)


def test_a_file_keeps_the_law_in_words(panda, tmp_path):
    task, x_d = aj.PositionTask(panda), aj.PositionTask(panda).value(START)
    laws = [aj.SetpointController(task, aj.Gains(kp, 80.0, 5.0)) for kp in (300.0, 400.0)]

    def change(loop):
        if loop.step == 2:
            loop.exchange(laws[1])

    run = aj.simulate(aj.Plant(panda, task), laws[0], x_d, START, 0.004, dt=1e-3, observer=change)
    lines = f"approxjac {aj.__version__}, dt 0.001 s\n{laws[0]}\nfrom t = 0.003 s:\n{laws[1]}"
    path = run.save(tmp_path / "run")
    assert aj.Trajectory.load(path).law == run.law == lines
    with np.load(path) as file:
        arrays = dict(file)
    texts = json.loads(str(arrays.pop("texts")))
    np.savez(path, texts=np.array(json.dumps(texts | {"law": 3})), **arrays)
    with pytest.raises(TrajectoryFileError, match="its law are no texts"):
        aj.Trajectory.load(path)


def test_a_run_of_a_wrapper_of_ones_own_is_saved(tmp_path):
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    law = Around(aj.SetpointController(task, aj.Gains(60.0, 20.0)))
    run = aj.simulate(aj.Plant(arm, task), law, (0.5, 1.2), (0.3, 0.8), 0.01, dt=1e-3)
    run.save(tmp_path / "run.npz")
    assert aj.Trajectory.load(tmp_path / "run.npz").law.endswith("within Around")


def test_v_is_of_the_rest_where_the_robot_adds_gravity(panda):
    told, loaded = (panda.with_object(0.1, mass) for mass in (0.3, 1.0))
    task = aj.PositionTask(told)
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(told, theta0=0.0))
    plant = aj.Plant(loaded, adds_gravity=told)
    run = aj.simulate(plant, law, task.value(START) + 0.05, START, 1.0, dt=1e-3, record_every=0.01)
    assert np.diff(run.V).max() < 1e-3 * run.V[0]
    assert run.V[-1] < 0.7 * run.V[0]


def test_joints_beyond_their_limits_are_told_with_their_time(panda):
    *_, run = reach(panda, setpoint)
    high = panda.position_limits[1]
    q = run.q.copy()
    q[:4, 1], q[5, 3] = high[1] + 0.02, high[3] + 0.01
    found = dataclasses.replace(run, q=q)
    assert found.at_stops == pytest.approx(
        {"panda_joint2": 4 / 11 * run.t[-1], "panda_joint4": 1 / 11 * run.t[-1]}
    )
    assert dataclasses.replace(found, scene=None).at_stops == {}
    assert run.at_stops == {}


def test_the_rate_of_V_is_exact_where_V_is_a_parabola(panda):
    *_, run = reach(panda, setpoint)
    found = dataclasses.replace(run)
    vars(found)["V"] = 3.0 - 2.0 * run.t + 40.0 * run.t**2
    assert_allclose(found.V_dot, 80.0 * run.t - 2.0, atol=1e-9)
