"""The stability map against the tests that it is made of."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import approxjac as aj
from approxjac.stability import stability_map
from approxjac.stability.map import PARAMETERS

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])


@pytest.fixture(scope="module")
def tools():
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    turn = {"panda_joint1": (0.0, 0.0, 0.5)}  # at 4 times beyond a right angle
    return aj.Uncertainty(arm, object_length=(0.0, 0.1), joint_rotations=turn)


@pytest.fixture(scope="module")
def controller(tools):
    return aj.SetpointController(tools.believed_task(), aj.Gains(400.0, 80.0, 5.0))


@pytest.fixture(scope="module")
def box(tools):
    return aj.JointBox.around(tools.arm, Q, 0.2)


@pytest.fixture(scope="module")
def found(controller, tools, box):
    return stability_map(
        controller, tools, box, names=("error", "a"), x=(0.0, 1.0, 2.0, 4.0), y=(2.0, 5.0, 20.0),
        coarse=2, configurations=40,
    )  # fmt: skip


def test_its_shapes_and_ends(found):
    assert found.decay_rate.shape == found.theorem1.shape == (3, 4)
    assert found.matrix.shape == found.rollouts.shape == (2, 2)
    assert_array_equal(found.coarse_x[[0, -1]], [0.0, 4.0])
    assert_array_equal(found.coarse_y[[0, -1]], [2.0, 20.0])
    assert np.isnan(found.rollouts).all()


def test_each_test_gives_way_in_its_turn(found):
    """Without errors all pass; Theorem 1 fails first, then the matrix form, then the arm."""
    assert (found.theorem1[:, 0] > 0.0).all()
    assert (found.theorem1[:, 1:] < 0.0).all()
    assert (found.matrix[:, 0] > 0.0).all()
    assert (found.matrix[:, -1] < 0.0).all()
    assert (found.decay_rate[:, :2] > 0.0).all()
    assert (found.decay_rate[:, -1] < 0.0).all()
    # what a stronger test certifies, the weaker ones let pass
    assert (found.decay_rate[:, 0][found.theorem1[:, 0] > 0.0] > 0.0).all()


def test_a_point_is_what_the_local_test_says(found, controller, tools, box):
    """With the controller's own gains, the worst of 200 targets, the true robots in turn."""
    errors = tools.scaled(2.0)
    plants = [errors.plant(corner) for corner in errors.corners()]
    own = aj.SetpointController(
        controller.task, controller.gains, gravity=aj.NoGravity(controller.task.robot)
    )
    drawn = box.sample(200, np.random.default_rng(0))
    rates = [
        aj.local_stability(plants[i % len(plants)], own, q).decay_rate for i, q in enumerate(drawn)
    ]
    assert found.targets == 16
    assert found.decay_rate[1, 2] == pytest.approx(min(rates), rel=1e-9)


def test_axes_may_be_swapped(found, controller, tools, box):
    swapped = stability_map(
        controller, tools, box, names=("a", "error"), x=(2.0, 5.0, 20.0), y=(0.0, 1.0, 2.0, 4.0),
        coarse=0,
    )  # fmt: skip
    assert_array_equal(swapped.decay_rate, found.decay_rate.T)
    assert np.isnan(swapped.theorem1).all()
    assert swapped.matrix.shape == (0, 0)


def test_any_two_parameters(controller, tools, box):
    damped = stability_map(
        controller, tools, box, names=("damping", "kv"), x=(0.2, 1.0, 5.0), y=(0.5, 2.0),
        coarse=2, configurations=20, runs=1, duration=0.2, targets=4,
    )  # fmt: skip
    assert set(PARAMETERS) == {"error", "a", "kv", "damping"}
    assert damped.matrix[0, -1] > damped.matrix[0, 0]  # damping certifies more
    assert set(np.unique(damped.rollouts)) <= {0.0, 1.0}


def test_it_repeats_bit_by_bit_and_progress_grows_to_one(controller, tools, box):
    seen = []
    maps = [
        stability_map(
            controller, tools, box, names=("error", "a"), x=(0.0, 1.0), y=(2.0, 5.0), targets=2,
            coarse=2, configurations=8, progress=progress,
        )
        for progress in (None, seen.append)
    ]  # fmt: skip
    for name in ("decay_rate", "theorem1", "matrix"):
        assert_array_equal(*(getattr(each, name) for each in maps))
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


@pytest.mark.parametrize(
    ("names", "x", "text"),
    [
        (("error", "b"), (0.0, 1.0), "parameter 'b' not in the map"),
        (("a", "a"), (1.0, 2.0), "names must be two different parameters"),
        (("a", "kv"), (0.0, 1.0), "values of a must be at least two growing numbers > 0"),
        (("error", "kv"), (-1.0, 1.0), "values of error must be at least two growing numbers >= 0"),
        (("error", "kv"), (1.0, 1.0), "values of error must be at least two growing numbers"),
        (("error", "kv"), (1.0,), "values of error must be at least two growing numbers"),
    ],
)
def test_refused(controller, tools, box, names, x, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text):
        stability_map(controller, tools, box, names=names, x=x, y=(1.0, 2.0))
