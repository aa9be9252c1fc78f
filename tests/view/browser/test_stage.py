"""What is drawn of a scene, worked out without a browser: cameras, and what differs."""

import base64
from types import SimpleNamespace

import numpy as np
import pytest
import umsgpack
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import FrameKinematics
from approxjac.view.browser.page import _image, _plots
from approxjac.view.browser.stage import Stage, grid

ROOM = aj.PinholeCamera.looking_at((0.8, 0.1, 0.6), (1.0, -3.0, 1.2), 500.0, (640, 480))
TURNED = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along x
ON_ARM = aj.PinholeCamera((400.0, 450.0), (640, 480), (0.1, 0.05, -0.02), TURNED, mount="link1")
PLANE = PlanarCamera(0.05, 3.0, 0.4, (0.002, -0.001))


def stage_of(arm, sensor=None, belief=None, task=None):
    return Stage(Scene(arm, belief, sensor, task, arm.effort_limits))


@pytest.mark.parametrize("camera", [ROOM, ON_ARM, PLANE], ids=["room", "arm", "plane"])
def test_a_point_lies_behind_its_image_as_it_is_drawn(two_link, camera, rng):
    """On the line of sight through its pixel, in the axes of what carries the camera."""
    carried = camera.mount is not None
    points = rng.uniform(-0.5, 0.5, (4, 3)) + [3.0, 0.0, 0.0] if carried else [[0.1, 0.0, 0.2]]
    sensor = aj.ImageTask(two_link, camera, points=points)
    (drawn,) = stage_of(two_link, sensor).cameras
    assert drawn["role"] == "true"
    assert drawn["mount"] == camera.mount
    if camera is PLANE:  # stands where the pinhole camera that sees the same does
        assert_allclose(np.abs(drawn["apex"]), [0.0, 3.0 - 0.05, 0.0], atol=1e-12)
    for q in ([0.1, 1.0], [-0.2, -0.7]):
        q, images = np.array(q), sensor.value(np.array(q)).reshape(-1, 2)
        tip = FrameKinematics(two_link, two_link.tip)
        R, p = tip.placement(q)
        places = np.array(points) if carried else np.array(points) @ R.T + p
        if carried:
            R, p = FrameKinematics(two_link, camera.mount).placement(q)
            places = (places - p) @ R
        for place, image in zip(places, images, strict=True):
            a, b = (image - drawn["low"]) / (drawn["high"] - drawn["low"])
            spot = drawn["corner"] + a * drawn["right"] + b * drawn["down"]
            sight, way = spot - drawn["apex"], place - drawn["apex"]
            along = way @ sight / (np.linalg.norm(way) * np.linalg.norm(sight))
            assert along == pytest.approx(1.0, abs=1e-9)


def test_what_is_believed_wrongly_differs(two_link):
    arm = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
    task = aj.PositionTask(arm, axes="xz")
    assert not stage_of(arm).differs
    assert not stage_of(arm, task, arm, task).differs
    for wrong in (
        arm.with_kinematic_error({"joint2": (0.0, 0.0, 1e-3)}),
        arm.with_kinematic_error(rotations={"joint2": (0.0, 1e-3, 0.0)}),
        aj.load_robot("two_link").with_object(0.4, 0.5, radius=0.0, axis="x"),
        aj.load_robot("two_link"),
    ):
        assert stage_of(arm, belief=wrong).differs
    for camera in (ROOM.with_error(shift=(0.0, 0.0, 1e-2)), ROOM.with_error(focal_factor=1.01)):
        tasks = (aj.ImageTask(arm, each) for each in (ROOM, camera))
        assert stage_of(arm, next(tasks), arm, next(tasks)).differs
    assert not stage_of(arm, aj.ImageTask(arm, ROOM), arm, aj.ImageTask(arm, ROOM)).differs


def test_cameras_in_the_world_are_in_view_and_carried_ones_are_not(two_link):
    room = stage_of(two_link, aj.ImageTask(two_link, ROOM))
    assert_allclose(room.camera_points[0], [1.0, -3.0, 1.2])
    assert room.camera_points.shape == (5, 3)
    carried = stage_of(two_link, aj.ImageTask(two_link, ON_ARM, points=[[2.0, 0.0, 0.0]]))
    assert carried.camera_points.shape == (0, 3)


def test_plots_and_images_are_in_the_units_and_borders_of_what_they_show(two_link):
    """An image as wide as its camera's; torques of joints that turn, and forces of others."""

    def shown(*labels, unit):
        run = {"task_labels": labels, "task_units": (unit,) * len(labels)}
        run |= {"units": {"tau": "N m", "command": "N m"}}
        return SimpleNamespace(command_kind="torque", has_torque=True, **run)

    scene = Scene(two_link, None, aj.ImageTask(two_link, ROOM), None, np.full(2, np.inf))
    image = _image(scene)
    assert image["border"] == [-0.5, -0.5, 639.5, 479.5]
    assert (image["unit"], image["down"], image["points"]) == ("px", True, 1)
    planar = _image(Scene(two_link, None, aj.ImageTask(two_link, PLANE), None, np.full(2, np.inf)))
    assert (planar["border"], planar["down"], planar["unit"]) == (None, False, "mm")
    units = {plot["column"]: plot["unit"] for plot in _plots(scene, shown("u", "v", unit="px"))}
    assert (units["error"], units["torque"]) == ("error [px]", "τ [N m]")
    limited = Scene(two_link, None, None, None, np.array([9.0, np.inf]))
    (torque,) = (p for p in _plots(limited, shown("x", unit="m")) if p["column"] == "torque")
    assert (torque["unit"], torque["lines"]) == ("τ / limit", [-1.0, 1.0])


def commands_of(listed):
    return [umsgpack.unpackb(base64.b64decode(each)) for each in listed]


def test_links_of_another_length_have_a_rod_and_objects_have_none():
    """An object is as long as it is drawn."""
    arm = aj.load_robot("two_link")
    truth = arm.with_object(0.5, axis="x")

    def rods(belief):
        paths = [
            each["path"] for each in commands_of(stage_of(truth, belief=belief).data()["commands"])
        ]
        return [path.split("/")[-2] for path in paths if "bone_" in path]

    assert rods(truth) == rods(arm.with_object(0.2, axis="x")) == []
    longer = truth.with_kinematic_error({"joint2": (0.1, 0.0, 0.0)})
    assert rods(longer) == ["link link1"]


def test_what_is_placed_in_a_link_is_where_it_belongs(two_link):
    """By three.js' matrices, column by column: a rod's ends, and points that a camera sees."""
    points = np.array([[0.1, -0.2, 0.3], [0.0, 0.05, -0.1]])
    belief = two_link.with_kinematic_error({"joint2": (0.07, -0.12, 0.2)})
    tasks = (aj.ImageTask(arm, ROOM, points=points) for arm in (two_link, belief))
    stage = stage_of(two_link, next(tasks), belief, next(tasks))
    placed = {"bone": [], "points_believed": []}
    for each in commands_of(stage.data("believed")["commands"]):
        for name in placed:
            if name in each["path"]:
                matrix = np.reshape(each["object"]["object"]["matrix"], (4, 4), order="F")
                placed[name].append((matrix, each["object"]["geometries"][0]))
    assert_allclose([matrix[:3, 3] for matrix, _ in placed["points_believed"]], points)
    ((matrix, rod),) = placed["bone"]
    ends = [(matrix @ [0.0, half * rod["height"], 0.0, 1.0])[:3] for half in (-0.5, 0.5)]
    assert_allclose(ends, [np.zeros(3), belief.model.jointPlacements[2].translation], atol=1e-12)


def test_the_grid_lies_on_the_floor_below_all_points():
    points = np.array([[0.3, -0.9, 1.0], [0.1, 0.2, 2.0]])
    (drawn,) = commands_of(grid(points, -0.4))
    (geometry,) = drawn["object"]["geometries"]
    array = geometry["data"]["attributes"]["position"]["array"]
    lines = np.frombuffer(array.data, "<f4").reshape(-1, 3)
    assert_allclose(lines[:, 2], -0.4)
    assert (np.abs(lines[:, :2]).max(axis=0) >= 0.9).all()
