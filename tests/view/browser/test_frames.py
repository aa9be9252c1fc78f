"""What the page shows at an instant, against kinematics computed directly."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import view
from approxjac.controllers import PredictedMeasurement
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import TrackerTask
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.page import page
from approxjac.view.browser.stage import Stage

TARGET = np.array([0.5, -0.1, 0.6])
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


class AtInstants(SimpleNamespace):
    """What is shown of a run."""

    def at(self, name, instants):
        return getattr(self, name)[instants]


def columns(scene, q, x, x_d, **given):
    n, nv = len(q), scene.truth.nv
    rest = {
        "t": np.arange(n, dtype=float), "error": x[:, :3] * 0.0, "tau": np.zeros((n, nv)),
        "task_torque": np.zeros((n, nv)), "V": np.zeros(n),
        "learnt": np.zeros((n, len(scene.parameters))),
    }  # fmt: skip
    shown = rest | given
    units = ("m",) * 3 if scene.sensor is None else scene.sensor.units
    shown |= {"task_units": units, "command_kind": "torque"}
    run = AtInstants(q=q, x_measured=x, x_d=x_d, **shown)
    return RunFrames(scene).columns(run)


@pytest.fixture
def scene(panda):
    truth = panda.with_object(0.2, 0.5, axis="x")
    belief = panda.with_object(0.0)
    return Scene(
        truth, belief, aj.PositionTask(truth), aj.PositionTask(belief), truth.effort_limits
    )


@pytest.fixture
def q(panda, rng):
    return np.array([panda.random_configuration(rng) for _ in range(4)])


def test_positions_are_those_of_the_two_robots(scene, q):
    x = np.array([scene.sensor.value(row) for row in q]) + 0.01
    x[2] = np.nan
    found = columns(scene, q, x, np.tile(TARGET, (4, 1)))
    assert_allclose(found["tip"], [scene.sensor.value(row) for row in q])
    assert_allclose(found["believed_tip"], [scene.task.value(row) for row in q])
    assert_array_equal(found["measured"], x)
    assert_array_equal(found["target"], np.tile(TARGET, (4, 1)))
    assert_allclose(found["joints"], q)
    assert not any(name.endswith("pixels") for name in found)


def test_axes_that_are_not_measured_are_those_of_the_true_tip(scene, q):
    sensor = aj.PositionTask(scene.truth, axes="zx")
    flat = dataclasses.replace(scene, sensor=sensor, task=aj.PositionTask(scene.belief, axes="zx"))
    found = columns(flat, q, np.tile([3.0, 1.0], (4, 1)), np.tile([6.0, 4.0], (4, 1)))
    assert_array_equal(found["measured"][:, [0, 2]], np.tile([1.0, 3.0], (4, 1)))
    assert_array_equal(found["target"][:, [0, 2]], np.tile([4.0, 6.0], (4, 1)))
    assert_array_equal(found["measured"][:, 1], found["tip"][:, 1])


def test_where_x_is_lost_in_part_there_is_no_position(scene, q):
    sensor = aj.PositionTask(scene.truth, axes="zx")
    flat = dataclasses.replace(scene, sensor=sensor, task=aj.PositionTask(scene.belief, axes="zx"))
    x = np.tile([3.0, 1.0], (4, 1))
    x[1, 0] = x[2, 1] = x[3] = np.nan
    found = columns(flat, q, x, np.tile([6.0, 4.0], (4, 1)))["measured"]
    assert np.isfinite(found).all(axis=1).tolist() == [True, False, False, False]
    assert np.isnan(found[1:]).all()


def test_the_force_is_the_one_that_the_task_torque_stands_for(scene, q, rng):
    force = rng.normal(size=(4, 3))
    J = [scene.task.jacobian(row) for row in q]
    torque = np.array([A.T @ f for A, f in zip(J, force, strict=True)])
    torque[3] = np.nan
    found = columns(scene, q, q[:, :3], q[:, :3], task_torque=torque)["force"]
    assert_allclose(found[:3], force[:3], atol=1e-9)
    assert np.isnan(found[3]).all()


def test_load_and_position_limits(scene, q):
    limits = scene.truth.effort_limits.copy()
    limits[1] = np.inf
    lower, upper = scene.truth.position_limits
    q[0, 3], q[1, 3], q[2, 5] = lower[3] + 0.009, lower[3] + 0.011, upper[5] + 1.0
    tau = np.tile(-0.5 * scene.truth.effort_limits, (4, 1))
    found = columns(
        dataclasses.replace(scene, torque_limits=limits), q, q[:, :3], q[:, :3], tau=tau
    )
    known = [0, 2, 3, 4, 5, 6]
    assert_allclose(found["load"][:, known], 0.5)
    assert_allclose(found["torque"][:, known], -0.5)
    assert np.isnan(found["load"][:, 1]).all()
    assert found["at_limit"][[0, 1, 2], [3, 3, 5]].tolist() == [1.0, 0.0, 1.0]


def test_between_shown_instants_the_largest_torque_counts_once(scene, q):
    """From the one after an instant that is shown up to the next that is, both ends included."""
    tau, n, kept = np.zeros((9, 7)), 9, [0, 2, 5, 8]
    tau[2, 0], tau[3, 1], tau[4, 1], tau[5, 2], tau[8, 3], tau[0, 4] = 3.0, 1.0, -2.0, 4.0, 6.0, 5.0
    free = dataclasses.replace(scene, torque_limits=np.full(7, np.inf))
    places = q[np.arange(n) % 4]
    run = AtInstants(
        q=places, x_measured=places[:, :3], x_d=places[:, :3], t=np.arange(9.0), tau=tau,
        error=np.zeros((n, 3)), task_torque=np.zeros((n, 7)), V=np.zeros(n),
        learnt=np.zeros((n, 0)), task_units=("m",) * 3, command_kind="torque",
    )  # fmt: skip
    wanted = np.zeros((4, 7))
    wanted[0, 4], wanted[1, 0], wanted[2, 1], wanted[2, 2], wanted[3, 3] = 5.0, 3.0, -2.0, 4.0, 6.0
    assert_array_equal(RunFrames(free).columns(run, kept)["torque"], wanted)


def test_without_any_limit_torques_are_torques(scene, q):
    tau = np.ones((4, 7))
    unlimited = dataclasses.replace(scene, torque_limits=np.full(7, np.inf))
    found = columns(unlimited, q, q[:, :3], q[:, :3], tau=tau)
    assert_array_equal(found["torque"], tau)
    assert np.isnan(found["load"]).all()


def test_errors_are_in_display_units(scene, q):
    found = columns(scene, q, q[:, :3], q[:, :3], error=np.full((4, 3), 0.002))
    assert_allclose(found["error"], 2.0)


def test_each_error_of_a_pose_is_in_the_display_unit_of_its_own(panda, q):
    task = aj.PoseTask(panda)
    scene = Scene(panda, panda, task, task, panda.effort_limits)
    x = np.array([task.value(row) for row in q])
    found = columns(scene, q, x, x, error=np.tile([0.002, 0, 0, 0.1, 0, 0.2], (4, 1)))["error"]
    assert_allclose(found, np.tile([2.0, 0, 0, np.degrees(0.1), 0, np.degrees(0.2)], (4, 1)))


@pytest.mark.parametrize("depth", ["believed", "measured"])
def test_images_are_those_of_both_cameras(scene, depth):
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -0.5, 0.7), 600.0, (640, 480))
    rolled = camera.with_error(rotation=(0.0, 0.0, 0.4))
    points = [[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]]
    sensor = aj.ImageTask(scene.truth, camera, points=points, depth=depth)
    task = aj.ImageTask(scene.belief, rolled, points=points)
    seen = dataclasses.replace(scene, sensor=sensor, task=task)
    q = np.array([[0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], [0.2, -0.4, 0.1, -2.0, 0.0, 1.5, 0.7]])
    x = np.array([sensor.value(row) for row in q])
    x_d = x + 5.0
    lost = x.copy()
    lost[1] = np.nan
    found = columns(seen, q, lost, x_d, error=np.ones((2, 4)))
    stride = 3 if depth == "measured" else 2
    images = x.reshape(2, 2, stride)[:, :, :2]
    assert_allclose(found["pixels"], images)
    assert_allclose(found["target_pixels"], images + 5.0)
    assert_allclose(found["measured_pixels"][0], images[0])
    assert np.isnan(found["measured_pixels"][1]).all()
    assert_allclose(found["believed_pixels"], [task.value(row).reshape(2, 2) for row in q])
    assert_allclose(found["error"], 1.0)
    assert np.isnan(found["target"]).all()
    assert_allclose(found["tip"], [aj.PositionTask(scene.truth).value(row) for row in q])


def test_an_eye_in_the_hand_moves_the_hand(scene):
    camera = aj.PinholeCamera(400.0, (640, 480), mount="panda_hand")
    sensor = aj.ImageTask(scene.truth, camera, points=[[0.5, 0.0, 0.0]])
    task = aj.ImageTask(scene.belief, camera, points=[[0.5, 0.0, 0.0]])
    q = np.array([[0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]])
    x = np.array([sensor.value(q[0])])
    found = columns(dataclasses.replace(scene, sensor=sensor, task=task), q, x, x)
    assert_allclose(found["tip"][0], aj.PositionTask(scene.truth).value(q[0]))
    assert_allclose(found["pixels"].ravel(), x[0])


def test_one_instant_and_none(scene, q):
    found = columns(scene, q, q[:, :3], q[:, :3])
    one = columns(scene, q[:1], q[:1, :3], q[:1, :3])
    none = columns(scene, q[:0], q[:0, :3], q[:0, :3])
    for name, column in found.items():
        assert_allclose(one[name], column[:1], err_msg=name)
        assert none[name].shape == (0, *column.shape[1:]), name


def test_a_task_of_ones_own_and_no_belief(scene, q):
    unknown = dataclasses.replace(scene, sensor=None, task=None, belief=None)
    found = columns(unknown, q, q[:, :3], q[:, :3])
    assert_allclose(found["tip"], [aj.PositionTask(scene.truth).value(row) for row in q])
    for name in ("measured", "target", "believed_tip", "force"):
        assert np.isnan(found[name]).all()


def test_a_moment_is_no_force(panda):
    """Of a pose the torque stands for a force and a moment; the arrow is the force."""
    task = aj.PoseTask(panda)
    scene = Scene(panda, panda, task, task, panda.effort_limits)
    q = START + 0.1
    J = task.jacobian(q)
    for wrench in (np.array([3.0, -2.0, 5.0, 0.0, 0.0, 0.0]), np.array([0, 0, 0, 2.0, 0.0, -20.0])):
        force = RunFrames(scene).columns(instant(task, q, J.T @ wrench))["force"][0]
        assert_allclose(force, wrench[:3], atol=1e-9)


@pytest.mark.parametrize("first", ["image", "height"])
def test_of_several_tasks_the_position_is_followed(panda, first):
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.5), (1.5, -0.8, 0.9), 600.0, (640, 480))
    tasks = {"image": aj.ImageTask(panda, camera), "height": aj.PositionTask(panda, axes="z")}
    order = [first, *(name for name in tasks if name != first)]
    task = aj.StackedTask(*(tasks[name] for name in order))
    scene = Scene(panda, panda, task, task, panda.effort_limits)
    found = RunFrames(scene).columns(instant(task, START, np.zeros(7)))
    tip = aj.PositionTask(panda).value(START)
    assert_allclose(found["target"][0], tip, atol=1e-12)
    assert_allclose(found["measured"][0], tip, atol=1e-12)
    assert_allclose(found["pixels"][0, 0], tasks["image"].value(START))
    none = RunFrames(scene).columns(instant(task, START, np.zeros(7)), np.arange(0))
    assert {name: len(column) for name, column in none.items()} == dict.fromkeys(found, 0)


def test_a_frame_that_the_belief_does_not_have_is_left_out(panda):
    truth = panda.with_object(0.2)
    sensor = aj.PositionTask(truth)
    scene = Scene(truth, panda, sensor, None, panda.effort_limits)  # the task was of its own kind
    found = RunFrames(scene).columns(instant(sensor, START, np.zeros(7)))
    hand = aj.PositionTask(panda).value(START)
    assert_allclose(found["believed_tip"][0], hand, atol=1e-12)


def instant(task, q, task_torque):
    x = task.value(q)
    rows = {
        "q": q, "x_measured": x, "x_d": x, "error": np.zeros(task.m), "tau": np.zeros(7),
        "task_torque": task_torque, "t": np.zeros(()), "V": np.zeros(()),
    }  # fmt: skip
    instants = {name: row[np.newaxis] for name, row in rows.items()}
    nothing = np.zeros((len(instants["t"]), 0))
    kind = {"task_units": task.units, "command_kind": "torque"}
    return AtInstants(learnt=nothing, **kind, **instants)


def test_no_link_has_the_name_of_a_shape(two_link):
    odd = two_link.with_object(0.1, name="shape0").with_object(0.1, name="bone_1")
    data = Stage(Scene(odd, odd, None, None, odd.effort_limits)).data()
    links = {tuple(link["path"]) for link in data["links"]}
    joints = {tuple(joint["path"]) for joint in data["joints"]["true"]}
    assert len(links) == len(data["links"])
    assert not links & joints


def test_the_floor_is_where_the_lowest_part_that_stands_is():
    """Of an arm on a pedestal, and of one that hangs; wherever its moving parts are."""
    for below, above in ((-0.4, 0.7), (-0.1, -0.6)):
        text = "".join(f'<link name="{name}"/>' for name in ("world", "foot", "base"))
        text += """<link name="arm"><inertial><mass value="1"/>
          <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
        for name, parent, child, z in (("f", "world", "foot", below), ("m", "foot", "base", above)):
            text += f'''<joint name="{name}" type="fixed"><parent link="{parent}"/>
              <child link="{child}"/><origin xyz="0 0 {z}"/></joint>'''
        text += """<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
          <origin xyz="0 0 -3"/><axis xyz="0 1 0"/>
          <limit lower="-2" upper="2" effort="5" velocity="1"/></joint>"""
        arm = aj.Robot(f'<robot name="standing">{text}</robot>')
        stage = Stage(Scene(arm, None, None, None, arm.effort_limits))
        assert stage.floor == pytest.approx(min(below, below + above))


def test_what_a_tracker_tells_is_drawn_in_the_world(panda):
    """Measured positions, and targets, of a tracker with axes of its own."""
    sensor = TrackerTask(panda, (0.2, -0.4, 1.0), (0.1, -0.05, 0.05))
    x_d = sensor.value(START + 0.1)
    controller = aj.SetpointController(aj.PositionTask(panda))
    run = aj.simulate(aj.Plant(panda, sensor), controller, x_d, START, 0.02, dt=1e-3)
    shown = RunFrames(run.scene).columns(run)
    assert_allclose(shown["measured"], shown["tip"], atol=1e-12)
    there = aj.PositionTask(panda).value(START + 0.1)
    assert_allclose(shown["target"], np.tile(there, (len(run.t), 1)), atol=1e-12)


@pytest.mark.study
@pytest.mark.parametrize(
    "law", [pytest.param("tracking law", marks=pytest.mark.long), "set-point law"]
)
def test_the_believed_tip_moves_onto_the_true_one_while_it_is_learnt(panda, law):
    """Also of a run that was saved and loaded."""
    plant, task = aj.Plant(panda.with_object(0.2, axis="x")), aj.PositionTask(panda)
    kinematics = aj.AdaptiveKinematics(task, unknown=("tool",), noise=1e-4)
    controller = aj.TrackingController(task, kinematics=kinematics)
    if law == "set-point law":
        controller = aj.TorqueLimited(aj.SetpointController(task), aj.Limits.of(panda))
        controller = PredictedMeasurement(controller, kinematics)
    x_d = plant.sensor.value(START) + [0.1, 0.1, 0.0]
    run = aj.simulate(plant, controller, x_d, START, 0.6, dt=1e-3, record_every=0.01)
    scene = Scene.from_dict(run.scene.to_dict())
    shown = RunFrames(scene).columns(run)
    apart = np.linalg.norm(shown["believed_tip"] - shown["tip"], axis=1)
    assert apart[0] == pytest.approx(0.2)
    assert apart[-1] < 2e-3
    assert np.isnan(run.V).all()  # which would be of what is predicted
    assert '"learnt tip"' in page(run)
    assert '"believed tip"' not in page(run)
    # and so it is in the plot
    ax = view.plot_path(run, scene.truth, believed=scene.belief)
    lines = {line.get_label(): np.array(line.get_data()).T for line in ax.get_lines()}
    assert_allclose(lines["as it is learnt"], shown["believed_tip"][:, [0, 2]], atol=1e-12)
    assert_allclose(lines["path of object_tip"], shown["tip"][:, [0, 2]], atol=1e-12)
    assert np.linalg.norm(lines["believed at first"] - lines["as it is learnt"], axis=1)[-1] > 0.05


@pytest.mark.study
def test_the_tip_of_an_image_task_is_the_learnt_one_too(panda):
    camera = aj.PinholeCamera.looking_at(
        (0.45, 0.0, 0.4), (1.5, -0.8, 0.9), focal_length=600.0, size=(640, 480)
    )
    truth = panda.with_object(0.1, axis="x")
    task = aj.ImageTask(panda, camera)
    kinematics = aj.controllers.AdaptiveCamera(task, unknown=("tool",), dt=2e-3)
    controller = aj.TrackingController(task, kinematics=kinematics, dt=2e-3)
    plant = aj.Plant(truth, aj.ImageTask(truth, camera))
    x_d = plant.sensor.value(START) + [60.0, -40.0]
    run = aj.simulate(plant, controller, x_d, START, 1.0, dt=2e-3, record_every=0.02)
    shown = RunFrames(run.scene).columns(run)
    arm = kinematics.robot(run.state[-1][-kinematics.n_state :])
    end = aj.PositionTask(arm).value(run.q[-1])
    assert_allclose(shown["believed_tip"][-1], end, atol=1e-9)
    apart = np.linalg.norm(shown["believed_tip"] - shown["tip"], axis=1)
    assert apart[-1] < 0.5 * apart[0]
    assert '"learnt tip"' in page(run)


@pytest.mark.parametrize("frame", ["panda_link4", "panda_link6"])
def test_a_frame_that_is_followed_is_drawn_on_both_robots(scene, q, frame):
    sensor, task = (aj.PositionTask(each, frame=frame) for each in (scene.truth, scene.belief))
    followed = dataclasses.replace(scene, sensor=sensor, task=task)
    x = np.array([sensor.value(row) for row in q])
    found = columns(followed, q, x, x + 0.1)
    assert_allclose(found["tip"], x)
    assert_allclose(found["believed_tip"], [task.value(row) for row in q])
