"""The stability map against the tests that it is made of."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import approxjac as aj
from approxjac.stability import stability_map
from approxjac.stability.search.map import PARAMETERS

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


# -- by rollouts --------------------------------------------------------------------------------

RUNS = {"runs": 6, "duration": 1.0, "dt": 4e-3, "tolerance": 0.05}


@pytest.fixture(scope="module")
def plane():
    """A controller of two links, errors and a region."""
    arm, task = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    errors = aj.Uncertainty(
        arm, task, object_length=(0.0, 0.4), object_axis="x",
        joint_rotations={"joint1": (0.0, 2.0, 0.0)},
    )  # fmt: skip
    law = aj.SetpointController(errors.believed_task())
    return law, errors, aj.JointBox.around(arm, [0.5, 1.2], 0.4)


def test_by_rollouts_over_parameters(plane):
    """Each point is what `rollouts` say there."""
    law, errors, region = plane
    drawn = stability_map(
        *plane, by="rollouts", names=("a", "error"), x=(1.0, 4.0, 8.0), y=(0.0, 1.0), **RUNS
    )
    assert drawn.rollouts.shape == drawn.runs.shape == (2, 3)
    assert (drawn.runs == 6).all()
    _, kv, damping = law.diagonals
    other = law.with_gains(aj.Gains(4.0 * kv, kv, damping))
    runs = aj.rollouts(other, errors.scaled(1.0), region, **RUNS)
    assert drawn.rollouts[1, 1] == runs.share
    assert tuple(drawn.intervals[1, 1]) == runs.interval
    assert np.isnan(drawn.decay_rate).all()
    assert "36 runs at (2, 3) points" in repr(drawn)
    assert "3 by 2, 36 runs in all" in str(drawn)


def test_by_rollouts_over_errors_and_places(plane):
    """Each run counts where it was drawn."""
    law = plane[0]
    turn, seen = "joint1 rotation y", []
    y = np.linspace(-2.0, 2.0, 5)
    drawn = stability_map(
        *plane, by="rollouts", names=("object_length", turn), x=(0.1, 0.3), y=y,
        progress=seen.append, **RUNS,
    )  # fmt: skip
    many = aj.rollouts(*plane, **RUNS | {"runs": 60})
    assert 40 < drawn.runs.sum() <= 60  # none beyond half a step from the ends
    length, angle = many.columns["values"].T
    here = (length < 0.2) & (np.abs(angle - 1.0) < 0.5)
    assert drawn.runs[3, 0] == here.sum() > 0
    assert drawn.rollouts[3, 0] == many.columns["converged"][here].mean()
    assert drawn.rollouts[2].mean() > drawn.rollouts[0].mean() == 0.0  # beyond a right angle
    assert seen[-1] == 1.0

    tips = np.array([law.task.value(q) for q in many.columns["q0"]])
    places = stability_map(
        *plane, by="rollouts", names=("x", "z"), x=(0.5, 1.5), y=(-4.0, 0.5, 1.5),
        **RUNS | {"runs": 10},
    )  # fmt: skip
    here = (np.abs(tips[:, 0] - 1.5) < 0.5) & (np.abs(tips[:, 1]) < 1.0)
    assert places.runs[1, 1] == here.sum() > 0
    assert places.rollouts[1, 1] == many.columns["converged"][here].mean()
    assert places.runs[0].sum() == 0
    assert np.isnan(places.rollouts[0]).all()
    assert_array_equal(places.intervals[0], [[0.0, 1.0]] * 2)


@pytest.mark.parametrize(
    ("names", "by", "text"),
    [
        (("object_length", "a"), "rollouts", "names must both be of what is drawn"),
        (("object_length", "roll"), "rollouts", "parameter 'roll' not in the map"),
        (
            ("object_length", "a"),
            "tests",
            "'object_length' not in the map; errors and places need by=\"rollouts\"; valid are a",
        ),
        (("a", "kv"), "eye", "by 'eye' not in stability_map"),
    ],
)
def test_refused_by_rollouts(plane, names, by, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text):
        stability_map(*plane, by=by, names=names, x=(0.1, 1.0), y=(0.1, 1.0))


def test_a_plot_that_is_given_a_map_says_which_of_its_arrays_it_takes(found):
    m = replace(found, rollouts=np.ones((3, 4)))
    for plot, arrays in ((aj.view.plot_shares, "m.rollouts, l"), (aj.view.plot_map, "m.decay_rat")):
        with pytest.raises(aj.InvalidInputError, match=f"a StabilityMap m: m.x, m.y, {arrays}"):
            plot(m)
    ax = aj.view.plot_shares(m.x, m.y, m.rollouts, labels=m.names)
    assert ax.get_xlabel() == "error"
    assert aj.view.plot_map(m.x, m.y, m.decay_rate, boundaries=[], labels=m.names)


def test_grown_errors_may_have_a_camera_look_elsewhere():
    """Then nothing is told there; of the given ones it is refused."""
    arm = aj.load_robot("two_link")
    task = functools.partial(aj.PositionTask, axes="xz")
    tip = task(arm).value([0.5, 1.2])
    place = np.array([tip[0], 0.0, tip[1]])
    camera = aj.PinholeCamera.looking_at(place, place + [0.0, -2.0, 0.0], 600.0, (640, 480))
    errors = aj.Uncertainty(arm, camera=camera, distance=(-0.9, 0.0))
    law = aj.SetpointController(errors.believed_task(), aj.Gains(2e-4, 4e-4, 1.0))
    region = aj.JointBox.around(arm, [0.5, 1.2], 0.05)
    options = {"by": "rollouts", "names": ("error", "kv"), "y": (0.5, 1.0), **RUNS, "runs": 8}
    drawn = stability_map(law, errors, region, x=(0.5, 4.0), **options)
    assert (drawn.runs == [[8, 0], [8, 0]]).all()
    assert np.isnan(drawn.rollouts[:, 1]).all()
    with pytest.raises(aj.InvalidInputError, match="must hold configurations that the true sensor"):
        stability_map(law, errors.scaled(4.0), region, x=(0.5, 1.0), **options)
