"""The search for the worst case: what it looks at, and that nothing found elsewhere is worse."""

import functools
import itertools
import math

import numpy as np
import pytest
from beliefs import belief_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import differential_evolution

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import Latency
from approxjac.stability.certificates.certificate import RESERVE, sampled_test
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.search.worst import (
    CaseBox,
    climb,
    fastest_growth,
    scored,
    searched_test,
    worst_constants,
    worst_margins,
)

PLANE = functools.partial(aj.PositionTask, axes="xz")
KHZ = Latency(1e-3)


def weightless(name):
    return aj.load_robot(name).with_gravity((0.0, 0.0, 0.0))


def law_of(errors, gains=None):
    return aj.SetpointController(errors.believed_task(), gains, gravity=aj.NoGravity(errors.arm))


@pytest.fixture(scope="module")
def tooled():
    """A UR5 with a tool that is longer or heavier than believed."""
    errors = aj.Uncertainty(
        weightless("ur5"), object_length=(0.0, 0.15), object_mass=(0.0, 0.5), object_axis="x"
    )
    region = aj.JointBox.around(errors.arm, (0.0, -1.2, 1.4, -1.0, -1.5, 0.0), 0.2)
    return ClosedLoop(law_of(errors, aj.Gains(400.0, 80.0, 5.0)), errors, region)


@pytest.fixture(scope="module")
def rolled():
    """A two-link arm before a camera whose roll and distance are not known."""
    camera = PlanarCamera(0.05, 3.0)
    errors = aj.Uncertainty(weightless("two_link"), camera=camera, roll=(-0.3, 0.4))
    region = aj.JointBox.around(errors.arm, (0.4, 1.2), 0.2)
    return ClosedLoop(law_of(errors, aj.Gains(5000.0, 10000.0, 1.0)), errors, region)


@pytest.fixture(scope="module")
def shifted():
    """A two-link arm whose links are longer or shorter than believed."""
    errors = aj.Uncertainty(
        weightless("two_link"), PLANE, joint_shifts={"joint2": (0.05, 0.0, 0.02)},
        object_length=(0.0, 0.1), object_axis="x",
    )  # fmt: skip
    region = aj.JointBox.around(errors.arm, (0.4, 1.2), 0.2)
    return ClosedLoop(law_of(errors, aj.Gains(60.0, 20.0, 2.0)), errors, region)


# -- climbing -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_the_largest_corner_of_a_multilinear_function_is_found(seed):
    """Against all of its 256 corners, of which one is the largest of all points."""
    rng, k = np.random.default_rng(seed), 8
    weights = rng.normal(size=2**k) / np.array([1.0 + bin(i).count("1") for i in range(2**k)]) ** 2
    subsets = np.array(list(itertools.product((0, 1), repeat=k)), dtype=bool)
    weights = weights[np.argsort(subsets.sum(axis=1))]
    subsets = subsets[np.argsort(subsets.sum(axis=1), kind="stable")]

    def score(z):
        return np.where(subsets, z[:, np.newaxis], 1.0).prod(axis=2) @ weights

    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=k)))
    z, best = climb(score, rng.uniform(-1.0, 1.0, (12, k)))
    assert_allclose(best, score(z))
    assert best.max() == pytest.approx(score(corners).max())
    assert_array_equal(np.abs(z[best.argmax()]), 1.0)


def test_a_maximum_inside_is_climbed_and_the_box_never_left():
    """A score that is none in half of the box, too: nothing there is kept."""
    middle, seen = np.array([0.3, -0.7, 0.05, 0.9, 0.2]), []

    def score(z):
        seen.append(z.copy())
        values = -((z - middle) ** 2).sum(axis=1)
        return np.where(z[:, 4] > 0.6, -np.inf, values)

    starts = np.random.default_rng(0).uniform(-1.0, 1.0, (10, 5))
    z, best = climb(score, starts, 40)
    assert np.abs(np.concatenate(seen)).max() <= 1.0
    assert best.max() > -0.02
    possible = starts[:, 4] <= 0.6
    assert 0 < possible.sum() < len(starts)
    assert_array_equal(z[~possible], starts[~possible])
    assert (best[~possible] == -np.inf).all()
    assert (best[possible] > score(starts[possible])).all()
    assert (z[possible, 4] <= 0.6).all()


def test_the_strongest_coordinates_are_flipped_together():
    """Two of ten, while the others lose by all but a short way along their slopes."""

    def score(z):
        return 2.0 * z[:, :2].sum(axis=1) + (0.1 * z[:, 2:] - 5.0 * z[:, 2:] ** 2).sum(axis=1)

    start = np.zeros((1, 10))
    start[0, :2] = -1.0
    z, best = climb(score, start, 2)
    assert best[0] > 3.9
    assert_array_equal(z[0, :2], 1.0)


def test_what_is_worse_than_any_number_ends_the_climb():
    """As of functions that are not positive; and what has no score at all is passed over."""
    z, best = climb(lambda z: np.where(z[:, 0] > 0.5, np.inf, z[:, 0]), np.zeros((1, 3)))
    assert best[0] == np.inf
    assert z[0, 0] > 0.5


def test_a_score_that_is_no_number_is_none(shifted):
    box = CaseBox(shifted, pairs=True)
    z = box.starts(12, np.random.default_rng(0))
    some = np.arange(12) % 3 == 0
    found = scored(shifted, box, lambda samples: np.where(some, np.nan, 1.0))(z)
    assert_array_equal(found, np.where(some, -np.inf, 1.0))


# -- cases ----------------------------------------------------------------------------------------


def uncertainties():
    belief, robot = belief_of(aj.load_robot("ur5"), off=3.0)
    arm = aj.load_robot("ur5")
    rotations = {"elbow_joint": (0.1, 0.0, 0.2), "wrist_1_joint": (0.0, 0.05, 0.0)}
    tool = {"object_length": (0.05, 0.3), "believed_length": 0.1}
    return {
        "box": aj.Uncertainty(arm, joint_rotations=rotations, **tool),
        "scaled": aj.Uncertainty(arm, joint_rotations=rotations, **tool).scaled(0.3),
        "no width": aj.Uncertainty(arm, object_mass=(0.2, 0.2), believed_mass=0.2, **tool),
        "covariance": aj.Uncertainty(robot, covariance=belief, object_mass=(0.0, 0.5)),
        "scaled covariance": aj.Uncertainty(robot, covariance=belief).scaled(0.4),
    }


@pytest.mark.parametrize("name", ["box", "scaled", "no width", "covariance", "scaled covariance"])
def test_units_are_those_of_values_and_cover_the_set(name):
    errors, rng = uncertainties()[name], np.random.default_rng(0)
    drawn = np.array([errors.sample(rng) for _ in range(300)])
    learnt = len(errors._root)
    size = np.linalg.norm(errors.units_of(drawn)[:, errors.d - learnt :], axis=1)
    if learnt:  # by the covariance 5 % of the draws are outside of the ellipsoid
        assert 0.0 < (size > 1.0).mean() < 0.12
        drawn = drawn[size <= 1.0]
    units = errors.units_of(drawn)
    assert (np.abs(units) <= 1.0 + 1e-12).all()
    assert_allclose(errors.at(units), drawn, rtol=1e-9, atol=1e-12)
    corners = errors.at(np.sign(rng.normal(size=(50, errors.d))))
    box = slice(0, errors.d - learnt)
    ends = np.stack([errors.low, errors.high])[:, np.newaxis, box]
    assert (np.abs(corners[:, box] - ends).min(axis=0) <= 1e-15).all()
    for values in (corners, errors.at(rng.uniform(-1.0, 1.0, (200, errors.d)))):
        assert (values >= errors.low - 1e-12).all()
        assert (values <= errors.high + 1e-12).all()
        white = np.linalg.solve(errors._root, values[:, errors.d - learnt :].T)
        radius = errors.factor * errors._radius if learnt else 0.0
        assert (np.linalg.norm(white, axis=0) <= radius * (1.0 + 1e-9)).all()
    if learnt:  # corners are on it
        white = np.linalg.solve(errors._root, corners[:, errors.d - learnt :].T)
        assert_allclose(np.linalg.norm(white, axis=0), radius, rtol=1e-9)


@pytest.mark.parametrize("name", ["tooled", "rolled", "shifted"])
def test_cases_are_the_samples_of_their_robots(name, request):
    loop, rng = request.getfixturevalue(name), np.random.default_rng(0)
    loop = ClosedLoop(loop.controller, loop.truth, loop.region)  # which keeps what is found
    values = np.array([loop.truth.sample(rng) for _ in range(5)])[[0, 1, 1, 2, 3, 4, 0]]
    q, ends = (loop.region.sample(7, rng) for _ in range(2))
    found, which = loop.judged(values, q, ends)
    assert_array_equal(which, np.arange(7))
    truths = loop.keep(values)
    assert_array_equal(loop.values[truths], values)
    expected = loop.samples_at(truths, q, loop.terms(truths, ends).x)
    for field in vars(expected).keys() - {"truth"}:
        one, other = getattr(found, field), getattr(expected, field)
        assert_allclose(one, other, rtol=1e-7, atol=1e-9 * np.abs(other).max(), err_msg=field)
    here, _ = loop.judged(values, q, None)  # each is its own target
    assert_allclose(here.e, 0.0, atol=1e-12)
    assert_allclose(here.x, found.x)


def test_what_is_no_case_is_left_out(shifted, rolled):
    rng = np.random.default_rng(1)
    region = aj.stability.RegularPart(shifted.region, shifted.controller.task, 0.47)
    loop = ClosedLoop(shifted.controller, shifted.truth, region)
    q, values = region.box.sample(60, rng), np.zeros((60, 3))
    q[3, 0] += 1.0
    _, which = loop.judged(values, q, None)
    inside = np.flatnonzero([region.contains(each) for each in q])
    assert 10 < len(inside) < 55
    assert 3 not in inside
    assert_array_equal(which, inside)
    # a roll there is, and a distance at which there is no such camera
    loop = ClosedLoop(rolled.controller, rolled.truth, rolled.region)
    errors = aj.Uncertainty(loop.truth.arm, camera=PlanarCamera(0.05, 3.0), distance=(2.0, 4.0))
    loop = ClosedLoop(law_of(errors, aj.Gains(5000.0, 10000.0, 1.0)), errors, loop.region)
    q = loop.region.sample(3, rng)
    found, which = loop.judged(np.array([[3.0], [-1.0], [2.5]]), q, None)
    assert_array_equal(which, [0, 2])
    assert_array_equal(found.q, q[[0, 2]])
    none, which = loop.judged(np.array([[-1.0]]), q[:1], None)
    assert len(none) == len(which) == 0


def test_what_a_camera_does_not_see_is_no_case():
    arm = weightless("two_link")
    camera = aj.PinholeCamera.looking_at((1.0, 0.0, 0.8), (1.0, -2.0, 0.8), 400.0, (320, 240))
    errors = aj.Uncertainty(arm, camera=camera, roll=(-0.3, 0.3))
    box = aj.JointBox(arm, (-1.2, 0.4), (0.2, 2.4))
    loop = ClosedLoop(law_of(errors, aj.Gains(2e-3, 1e-3, 0.5)), errors, box)
    rng = np.random.default_rng(0)
    q, ends, values = box.sample(80, rng), box.sample(80, rng), rng.uniform(-0.3, 0.3, (80, 1))
    sees = [
        [np.isfinite(errors.plant(v).sensor.visible(errors.plant(v).sensor.value(each))).all()
         for v, each in zip(values, some, strict=True)]
        for some in (q, ends)
    ]  # fmt: skip
    found, which = loop.judged(values, q, ends)
    assert_array_equal(which, np.flatnonzero(np.all(sees, axis=0)))
    assert_array_equal(found.q, q[which])
    _, which = loop.judged(values, q, None)
    assert_array_equal(which, np.flatnonzero(sees[0]))
    assert 0 < len(which) < 80
    # starts are cases, though few of all points are
    started = CaseBox(loop, pairs=True)
    _, which = loop.judged(*started.cases(started.starts(12, rng)))
    assert len(which) >= 10


@pytest.mark.parametrize("name", ["tooled", "shifted"])
def test_with_one_target_it_is_attained(name, request):
    loop, rng = request.getfixturevalue(name), np.random.default_rng(0)
    middle = loop.region.box.center
    target = loop.controller.task.value(middle + 0.03)
    region = aj.JointBox.around(loop.region.robot, middle, 0.5)
    loop = ClosedLoop(loop.controller, loop.truth, region, target)
    box = CaseBox(loop, pairs=False)
    z = box.starts(30, rng)
    z[15:, box.size - loop.region.robot.nv :] = rng.uniform(-1.0, 1.0, (15, loop.region.robot.nv))
    cases = box.cases(z)
    found, which = loop.judged(*cases)
    assert len(which) > 15
    for k, values, q in zip(which, cases.values[which], found.q, strict=True):
        assert_allclose(loop.truth.plant(values).sensor.value(q), target, atol=1e-7)
        assert loop.region.contains(q)
        assert k in range(30)
    assert_allclose(found.x_d, np.tile(target, (len(which), 1)))
    pairs = CaseBox(loop, pairs=True)  # errors to the target, from any configuration
    cases = pairs.cases(pairs.starts(9, rng))
    found, which = loop.judged(*cases)
    assert_array_equal(found.q, cases.q[which])
    assert_allclose(found.x_d, np.tile(target, (len(which), 1)))
    assert np.linalg.norm(found.e, axis=1).min() > 0.0


def test_a_target_out_of_a_robots_reach_is_no_case_of_it(shifted):
    q = np.array([[0.4, 0.3]] * 3)
    values = np.array([shifted.truth.low, shifted.truth.high, shifted.truth.low])
    target = shifted.truth.plant(values[1]).sensor.value(np.array([0.4, 0.05]))
    region = aj.JointBox.around(shifted.truth.arm, q[0], 1.0)
    loop = ClosedLoop(shifted.controller, shifted.truth, region, target)
    found, which = loop.judged(values, q, None)
    assert_array_equal(which, [1])
    assert_allclose(loop.truth.plant(values[1]).sensor.value(found.q[0]), target, atol=1e-7)


# -- what is found --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tooled", "rolled"])
def test_no_random_case_is_worse_than_what_is_found(name, request):
    """For growth, of single robots and places; for the margin and each constant in it."""
    loop, rng = request.getfixturevalue(name), np.random.default_rng(3)
    timing = KHZ.in_samples()
    growth = fastest_growth(loop, timing, 6, rng)
    box = CaseBox(loop, pairs=False)
    z = rng.uniform(-1.0, 1.0, (240, box.size))
    z[::2] = np.sign(z[::2])
    rates = loop.growth(loop.judged(*box.cases(z))[0], timing)
    assert growth.rate >= rates.max() - 0.01 * np.abs(rates.max())
    here, _ = loop.judged(growth.values[np.newaxis], growth.q[np.newaxis], None)
    assert loop.growth(here, timing)[0] == pytest.approx(growth.rate, rel=1e-9)
    assert not growth.grows
    test = sampled_test(loop, loop.draw(40, rng), KHZ)
    pairs = CaseBox(loop, pairs=True)
    z = rng.uniform(-1.0, 1.0, (240, pairs.size))
    z[::2] = np.sign(z[::2])
    drawn, _ = loop.judged(*pairs.cases(z))
    kept = len(loop.values)
    found = worst_margins(loop, test.form, test.weights, 12, rng)
    margins = [test.form.elsewhere(each).margins(test.weights).min() for each in (found, drawn)]
    assert margins[0] <= margins[1] + 2e-3
    assert_array_equal(np.unique(found.truth), np.arange(kept, len(loop.values)))  # all are kept
    again = loop.terms(found.truth, found.q, found.x_d)
    assert_allclose(again.J, found.J, rtol=1e-9, atol=1e-12)
    assert_allclose(again.M, found.M, rtol=1e-9, atol=1e-12)
    some = np.array([loop.truth.sample(rng) for _ in range(3)])
    truths = loop.keep(some)
    assert_array_equal(loop.values[truths], some)
    found = worst_constants(loop, test.form, 2, rng)
    for constant in [*test.form.constants, "energy"]:
        sizes = [test.form.elsewhere(each).constant(constant).max() for each in (found, drawn)]
        assert sizes[0] >= 0.97 * sizes[1], constant


def test_what_is_found_joins_what_the_function_is_chosen_on(shifted):
    loop = ClosedLoop(shifted.controller, shifted.truth, shifted.region)
    first = loop.draw(30, np.random.default_rng(0))
    shares, rng = [], np.random.default_rng(1)
    test = searched_test(loop, KHZ, first, rng, shares.append)
    samples = test.form.samples
    assert test.certified
    constants = [*test.form.constants, "energy"]  # three searches each, then 6 and 12 of margins
    assert len(samples) == len(test.margins) >= len(first) + 3 * len(constants) + 18
    for field in ("q", "x_d", "truth"):
        assert_array_equal(getattr(samples, field)[: len(first)], getattr(first, field))
    assert_allclose(test.form.elsewhere(samples).margins(test.weights), test.margins)
    assert test.margin >= RESERVE
    assert shares == sorted(shares)
    plain = searched_test(loop, KHZ, first, rng, rounds=0)
    assert len(plain.margins) == len(first)
    # largest constants are of all that was found
    for name in plain.form.constants:
        assert getattr(test.form.turning, name) >= getattr(plain.form.turning, name) * (1 - 1e-12)


# -- the certificate that was false ---------------------------------------------------------------


@pytest.fixture(scope="module")
def all_joints():
    """A Panda all of whose joints may be turned by 7.4° and off by 39 mm."""
    arm = weightless("panda")
    errors = aj.Uncertainty(
        arm,
        joint_rotations=dict.fromkeys(arm.joint_names, (0.13,) * 3),
        joint_shifts=dict.fromkeys(arm.joint_names, (0.039,) * 3),
    )
    box = aj.JointBox.around(arm, [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], 0.15)
    return law_of(errors), errors, box


def require_diverging(plant, law, growth):
    """The robot that was found, simulated near its target, leaves it."""
    dt = 1e-3
    target = plant.sensor.value(growth.q)
    rng = np.random.default_rng(0)
    q0 = growth.q + 1e-4 * rng.normal(size=len(growth.q))
    duration = dt * math.ceil(min(12.0 / growth.rate, 30.0) / dt)
    try:
        run = aj.simulate(plant, law, target, q0, duration, dt=dt, record_every=0.01)
    except aj.errors.SimulationError:
        return  # it diverged
    assert run.error_norm[-1] > 5.0 * run.error_norm[0]


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.study) for k in range(1, 11))]
)
def test_the_robot_that_refutes_a_panda_with_all_joints_off_is_found(all_joints, seed):
    law, errors, box = all_joints
    loop = ClosedLoop(law, errors, box)
    growth = fastest_growth(loop, KHZ.in_samples(), 12, np.random.default_rng(seed))
    assert growth.grows
    assert growth.rate > 0.0
    assert (np.abs(errors.units_of(growth.values[np.newaxis])) <= 1.0 + 1e-12).all()
    assert box.contains(growth.q)
    plant = errors.plant(growth.values)
    local = aj.local_stability(plant, law, growth.q, 1e-3)
    assert not local.stable
    assert -local.decay_rate == pytest.approx(growth.rate, rel=1e-6)
    if seed:  # ten runs are of the study
        require_diverging(plant, law, growth)


@pytest.mark.study
def test_a_report_refutes_it_and_names_the_robot(all_joints):
    report = aj.Study(*all_joints).report(200)
    assert (report.refuted, report.passed, report.reason) == (True, False, "unstable")
    assert report.rows[0].verdict == "refuted"
    k = np.abs(report.loop.truth.units_of(report.growth.values[np.newaxis])[0]).argmax()
    named = report.loop.truth.names[k]
    assert named.split()[0] in report.verdict()
    assert report.summary()["worst"]["near targets"]["values"] == report.growth.values.tolist()


# -- an attack by other means ---------------------------------------------------------------------


def attacked(loop, test, seed):
    """The least margin that differential evolution finds in about 3 000 cases, and their number."""
    box, looks = CaseBox(loop, pairs=True), 0
    score = scored(loop, box, lambda samples: -test.form.elsewhere(samples).margins(test.weights))

    def margins(z):
        nonlocal looks
        looks += z.shape[1]
        return np.minimum(-score(z.T), 10.0)  # what is no case is not bad

    sized = max(1, round(60 / box.size))
    found = differential_evolution(
        margins, [(-1.0, 1.0)] * box.size, vectorized=True, updating="deferred", polish=False,
        popsize=sized, maxiter=math.ceil(3000 / (sized * box.size)), tol=0.0, rng=seed,
    )  # fmt: skip
    return float(found.fun), looks


@pytest.mark.study
@pytest.mark.parametrize("name", ["shifted", "tooled", "rolled"])
def test_another_search_finds_no_case_that_a_certificate_misses(name, request):
    loop = request.getfixturevalue(name)
    report = aj.Study(loop.controller, loop.truth, loop.region).report(400)
    assert report.passed
    least, looks = attacked(report.loop, report.test, 5)
    assert looks >= 3000
    assert least > 0.0
    assert least > report.test.margin - 2.0 * RESERVE
    # and it would find one: of a function that was chosen on the belief alone
    certain = loop.truth.scaled(0.0)
    exact = ClosedLoop(loop.controller, certain, loop.region)
    wrong = sampled_test(exact, exact.draw(40, np.random.default_rng(0)), KHZ)
    far = ClosedLoop(loop.controller, loop.truth.scaled(2.5), loop.region)
    assert attacked(far, wrong, 5)[0] < wrong.margin - 0.2


class Needle(aj.stability.Region):
    """A path of configurations so thin that no random point is in it."""

    def __init__(self, robot):
        self.robot = robot

    def sample(self, n, rng):
        return np.array([0.4, 1.2]) + rng.uniform(0.0, 0.2, (n, 1))

    def contains(self, q):
        return bool(abs(q[1] - q[0] - 0.8) < 1e-9)


def test_a_region_that_no_start_hits_is_looked_at_where_it_draws():
    robot = weightless("two_link")
    errors = aj.Uncertainty(robot, PLANE, object_length=(0.0, 0.2), object_axis="x")
    loop = ClosedLoop(law_of(errors, aj.Gains(60.0, 20.0, 2.0)), errors, Needle(robot))
    found = fastest_growth(loop, KHZ.in_samples(), 6, np.random.default_rng(0))
    assert -100.0 < found.rate < 0.0
    assert loop.region.contains(found.q)
    truth = errors.plant(found.values)
    own = ClosedLoop(loop.controller, truth, loop.region)
    at = own.samples_at(np.zeros(1, dtype=int), found.q[None], truth.sensor.value(found.q)[None])
    assert_allclose(own.growth(at, KHZ.in_samples()), found.rate, rtol=1e-9)


def test_further_cases_count_with_their_own_constants(tooled):
    """A constant of the proof that they exceed is no bound: the function is judged by theirs."""
    rng = np.random.default_rng(2)
    test = sampled_test(tooled, tooled.draw(8, rng), KHZ)
    fresh = tooled.draw(40, rng)
    widened, blind = test.form.widened(fresh), test.form.elsewhere(fresh)
    assert widened.turning.fastest >= blind.turning.fastest == test.form.turning.fastest
    assert max(widened.constant("curvature")) <= widened.turning.curvature
    assert max(blind.constant("curvature")) > blind.turning.curvature
    faster = test.form.changed(speed=10.0 * test.speed)  # as if it were this that mattered
    exceeds = faster.widened(fresh).margins(test.weights)
    assert (exceeds < faster.elsewhere(fresh).margins(test.weights)).all()
