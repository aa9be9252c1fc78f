"""Which gravity parameters of Eq. (27) a motion tells apart, and so Eq. (29) can learn."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import GravityRegressor, excitation

BENT = np.array([0.0, -0.4, 0.3, -1.9, 0.2, 1.6, 0.4])


def by_least_squares(regressor, configurations):
    """Effect, own and rank: each column's residual when the others explain it as they can."""
    Z = np.vstack([regressor.Z(q) for q in configurations]) / np.sqrt(len(configurations))
    own = []
    for k in range(regressor.p):
        others = np.delete(Z, k, axis=1)
        best = np.linalg.lstsq(others, Z[:, k], rcond=1e-10)[0]
        own.append(np.linalg.norm(Z[:, k] - others @ best))
    effect = np.sqrt((Z**2).sum(axis=0))
    return effect, np.array(own)


def motions(robot):
    rng = np.random.default_rng(2)
    anywhere = np.array([robot.random_configuration(rng) for _ in range(40)])
    return {
        "one configuration": anywhere[:1],
        "two configurations": anywhere[:2],
        "a small motion": anywhere[0] + 0.05 * rng.normal(size=(30, robot.nv)),
        "the first joint": anywhere[0] + np.outer(np.linspace(-1, 1, 20), np.eye(robot.nv)[0]),
        "the last joint": anywhere[0] + np.outer(np.linspace(-1, 1, 20), np.eye(robot.nv)[-1]),
        "anywhere": anywhere,
    }


@pytest.mark.parametrize("motion", motions(aj.load_robot("two_link")))
@pytest.mark.parametrize("name", ["two_link", "so100", "panda", "xarm7"])
def test_effect_and_own_are_those_of_least_squares(name, motion):
    robot = aj.load_robot(name)
    regressor, configurations = GravityRegressor(robot), motions(robot)[motion]
    report = excitation(regressor, configurations)
    effect, own = by_least_squares(regressor, configurations)
    assert report.names == regressor.names
    assert_allclose(report.effect, effect, atol=1e-12)
    assert_allclose(report.own, own, rtol=1e-4, atol=1e-5 * effect.max())
    assert (report.own <= report.effect * (1 + 1e-9)).all()
    large = (own >= 0.05 * effect) & (effect > 1e-9)
    assert report.excited == tuple(np.array(regressor.names)[large])
    assert report.rank <= min(regressor.p, robot.nv * len(configurations))


def test_one_configuration_tells_no_more_combinations_than_it_has_torques(two_link):
    """Two torques for four parameters: two combinations are seen, and no parameter by itself."""
    regressor = GravityRegressor(aj.load_robot("two_link"))
    assert regressor.p == 4
    report = excitation(regressor, [[0.5, 1.0]])
    assert report.rank == 2
    assert_allclose(report.own, np.zeros(4), atol=0)
    assert report.excited == ()
    # the paper's two parameters are told apart by one configuration
    papers = GravityRegressor(two_link, "x")
    report = excitation(papers, [[0.5, 1.0]])
    assert report.rank == 2
    assert report.excited == papers.names


def test_a_rich_motion_excites_everything(panda):
    regressor = GravityRegressor(panda)
    report = excitation(regressor, motions(panda)["anywhere"])
    assert report.rank == 12
    assert report.excited == regressor.names


def test_moving_the_last_joint_leaves_what_is_before_it_unexcited(panda):
    report = excitation(
        GravityRegressor(panda), BENT + np.outer(np.linspace(-1, 1, 20), np.eye(7)[6])
    )
    assert report.rank == 7
    assert report.excited == ("panda_joint7.mx", "panda_joint7.my")
    assert_allclose(report.own[:-2], np.zeros(10), atol=0)


def test_a_vertical_joint_axis_excites_nothing_more_than_one_configuration(panda):
    """Turning about the vertical changes no gravity torque."""
    regressor = GravityRegressor(panda)
    turning = excitation(
        regressor, BENT + np.outer(np.linspace(-1, 1, 20), np.eye(7)[0])
    )  # fmt: skip
    still = excitation(regressor, [BENT])
    assert turning.rank == still.rank == 6
    assert turning.excited == still.excited == ()
    assert_allclose(turning.effect, still.effect, rtol=1e-9)


def test_a_parameter_without_any_effect_is_not_excited(two_link):
    """The inner link upright: its first moment along it has no lever, the outer one's neither."""
    regressor = GravityRegressor(two_link, "x")
    upright = -np.pi / 2  # x up
    report = excitation(regressor, [[upright, 0.0]])
    assert_allclose(report.effect, np.zeros(2), atol=1e-14)
    exact = excitation(regressor, [[0.0, 0.0]])
    assert exact.effect.min() > 1.0
    level = excitation(regressor, [[upright, 0.5]])
    assert level.effect[0] < 1e-14
    assert "joint2.mx" in level.excited
    assert "joint1.mx" not in level.excited


def test_the_threshold_decides_what_counts(panda):
    regressor = GravityRegressor(panda)
    configurations = motions(panda)["a small motion"]
    counts = [len(excitation(regressor, configurations, t).excited) for t in (1e-3, 0.05, 0.5, 1.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]
    ranks = [excitation(regressor, configurations, t).rank for t in (1e-4, 0.05, 1.0)]
    assert ranks == sorted(ranks, reverse=True)
    assert ranks[0] > ranks[-1]


def test_repr_has_one_line_for_each_parameter(panda):
    regressor = GravityRegressor(panda)
    report = excitation(regressor, BENT + np.outer(np.linspace(-1, 1, 20), np.eye(7)[6]))
    head, columns, *lines = repr(report).splitlines()
    assert head == "Excitation: 7 of 12 combinations"
    assert columns.split() == ["effect", "own", "excited", "[N", "m", "per", "unit]"]
    assert [line.split()[0] for line in lines] == list(regressor.names)
    assert [line.split()[-1] for line in lines] == ["no"] * 10 + ["yes"] * 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((np.zeros((0, 7)),), r"q must have shape \(N, 7\) \[rad or m\], got shape \(0, 7\)"),
        ((np.zeros(7),), r"q must have shape \(N, 7\) \[rad or m\], got shape \(7,\)"),
        ((np.zeros((3, 6)),), r"q must have shape \(N, 7\) \[rad or m\], got shape \(3, 6\)"),
        (([[np.nan] * 7],), r"q must be finite \[rad or m\], got \[\[nan"),
        (([[1.0, 2.0], [3.0]],), r"q must be numbers of shape \(N, 7\) \[rad or m\], got \[\[1"),
        (("far",), r"q must be numbers of shape \(N, 7\)"),
        ((BENT[None], 0.0), "threshold must be a finite number > 0 and <= 1, got 0.0"),
        ((BENT[None], np.nan), "threshold must be a finite number > 0 and <= 1, got nan"),
        ((BENT[None], 1.1), "threshold must be a finite number > 0 and <= 1, got 1.1"),
    ],
)
def test_bad_arguments_are_refused(panda, arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        excitation(GravityRegressor(panda), *arguments)


def test_another_object_than_a_regressor_is_refused(panda):
    with pytest.raises(aj.InvalidInputError, match="regressor must be a GravityRegressor, got Rob"):
        excitation(panda, BENT[None])
