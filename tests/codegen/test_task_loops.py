"""Closed loops of poses and images in lanes, compared with the same runs in Python."""

import functools

import numpy as np
import pytest
from many_runs import rolled
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.codegen import compiled
from approxjac.controllers import DifferentiatedVelocity
from approxjac.simulation.simulate import SampledLoop
from approxjac.tasks import NonsingularTask

SHORT = {"runs": 5, "duration": 0.3, "dt": 2e-3, "accuracy": 0.05}
SQUARE = ((0.2, 0.0, 0.05), (-0.1, 0.2, 0.0), (0.0, -0.2, 0.2))
FLOOR = ((0.4, 0.0, -0.5), (0.6, 0.1, -0.5), (0.5, -0.2, -0.4))
BENT = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
PINHOLE = aj.PinholeCamera.looking_at(
    (0.45, 0.0, 0.4), (1.1, -0.3, 0.9), 300.0, (640, 480), distortion=(-0.05, 0.01)
)
NARROW = aj.PinholeCamera.looking_at((0.45, 0.0, 0.4), (1.1, -0.3, 0.9), 300.0, (150, 150))
HAND = aj.PinholeCamera(200.0, (640, 480), (0.02, 0.0, 0.05), mount="panda_hand_tcp")
OVERSHOOTS = {"gains": aj.Gains(0.02, 0.0002, 0.5)}
ERRORS = {"focal_length": (280.0, 320.0), "distance": (-0.05, 0.05), "roll": (-0.1, 0.1)}


def panda(task=None, camera=None, width=0.3, errors=(), law=(), of=lambda task: task, **options):
    """A controller, its errors, and a region."""
    arm = aj.load_robot("panda")
    errors = {} if camera is None else dict(errors or ERRORS)
    known = aj.Uncertainty(
        arm, functools.partial(task or aj.ImageTask, **options), object_length=(0.0, 0.2),
        object_mass=(0.0, 0.5), friction=0.1, camera=camera, **errors,
    )  # fmt: skip
    controller = aj.SetpointController(of(known.believed_task()), **dict(law))
    return controller, known, aj.JointBox(arm, -np.full(7, width), np.full(7, width), BENT)


def planar():
    arm = aj.load_robot("two_link")
    known = aj.Uncertainty(
        arm, camera=PlanarCamera(0.016, 0.8, 0.3), object_length=(0.0, 0.3), object_axis="x",
        focal_length=(0.015, 0.018), distance=(0.7, 0.9), roll=(0.1, 0.5), friction=0.2,
    )  # fmt: skip
    return aj.SetpointController(known.believed_task()), known, aj.JointBox(arm)


def learns():
    return {"gravity": aj.AdaptiveGravity(aj.load_robot("panda"))}


def combined(robot, camera):
    image = aj.ImageTask(robot, camera)
    return aj.StackedTask(image, aj.PositionTask(robot, axes="z"))


STUDIES = {
    "pose": lambda: panda(aj.PoseTask),
    "pose, learnt": lambda: panda(aj.PoseTask, law=learns()),
    "planar camera": planar,
    "three points, a lens": lambda: panda(camera=PINHOLE, points=SQUARE),
    "a point, learnt": lambda: panda(camera=PINHOLE, law=learns()),
    "measured depth": lambda: panda(camera=PINHOLE, depth="measured"),
    "tilted and shifted": lambda: panda(
        camera=PINHOLE, errors={"roll": (-0.2, 0.2), "tilt": (0.1, 0.1), "shift": (0.1, 0.0, 0.2)}
    ),
    "a depth": lambda: panda(camera=PINHOLE, depth=1.0),
    "lost at times": lambda: panda(camera=NARROW, width=0.6, law=OVERSHOOTS),
    "lost at times, (5), learnt": lambda: panda(
        camera=NARROW,
        width=0.6,
        law={"velocity": DifferentiatedVelocity(0.02), **learns(), **OVERSHOOTS},
    ),
    "in the hand": lambda: panda(camera=HAND, points=FLOOR, errors={"focal_length": (180, 220)}),
    "image and position": lambda: panda(combined, PINHOLE),
    "nonsingular": lambda: panda(
        aj.PositionTask, of=lambda task: NonsingularTask(task, {"panda_joint4": 0.3}, 0.5)
    ),
    "balanced": lambda: panda(
        camera=PINHOLE,
        points=SQUARE,
        of=lambda task: aj.tasks.CombinedTask.balanced(task, task.value(BENT)),
    ),
}
BY_DEFAULT = ("planar camera", "lost at times")


@pytest.mark.parametrize(
    "name",
    [pytest.param(k, marks=() if k in BY_DEFAULT else pytest.mark.study) for k in STUDIES],
)
def test_runs_are_those_of_python(name):
    loop = STUDIES[name]()
    ours = rolled(*loop, engine="lanes", **SHORT)
    python = rolled(*loop, engine="python", **SHORT)
    for column, expected in python.columns.items():
        found = ours.columns[column]
        if found.dtype == bool:
            assert_array_equal(found, expected, err_msg=column)
        else:
            assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=column)
    if name.startswith("lost"):
        runs = (ours.replay(run.index) for run in ours.runs)
        assert any(aj.Status.MEASUREMENT_LOST in run.status for run in runs)


# those that differ most: in short, and in lanes, all are run above
WHOLE = ("pose, learnt", "lost at times", "in the hand", "nonsingular", "balanced")


@pytest.mark.study
@pytest.mark.parametrize(
    "name", [k if k in WHOLE else pytest.param(k, marks=pytest.mark.long) for k in STUDIES]
)
def test_one_whole_run_is_that_of_python(name, monkeypatch):
    controller, known, region = STUDIES[name]()
    few = rolled(controller, known, region, engine="python", **SHORT | {"runs": 1})
    start = few.setting.start(1)
    options = {
        "duration": 4.2,
        "dt": 2e-3,
        "computation": aj.simulation.Computation("semi_implicit_euler"),
    }
    plain = aj.simulate(start.plant, controller, start.target, start.q, **options)
    monkeypatch.delattr(SampledLoop, "advance")
    quick = aj.simulate(start.plant, compiled(controller), start.target, start.q, **options)
    assert_array_equal(quick.status, plain.status)
    for part in ("q", "v", "x", "x_measured", "error", "tau"):
        found, expected = getattr(quick, part), getattr(plain, part)
        size = 1.0 + np.nanmax(np.abs(expected))
        assert_allclose(found / size, expected / size, rtol=0, atol=1e-9, err_msg=part)
    if name == "lost at times":
        assert aj.Status.MEASUREMENT_LOST in plain.status
