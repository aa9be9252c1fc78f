"""Certified moves: the runs of adversarial robots stay within the bounds, sampled as they run."""

import functools
import itertools
import math

import numpy as np
import pytest

import approxjac as aj
from approxjac import law
from approxjac.controllers import Latency
from approxjac.paths import Line as Path
from approxjac.robots.traced import motion_between
from approxjac.stability.certificates.matrix_form import Hold, best_weights
from approxjac.stability.certificates.moves import EasedLine, MovingForm, Tube, largest
from approxjac.stability.search.certified_moves import MoveSearch, TubeBox, between, slow_path

PLANE = functools.partial(aj.PositionTask, axes="xz")
STARTS = {
    "two_link": [0.5, 1.2],
    "ur5": [0.0, -1.2, 1.5, -0.8, -1.5, 0.3],
    "baxter_left_arm": [0.1, -0.5, 0.0, 1.2, 0.1, 0.8, 0.0],
    "z1": [0.1, 1.2, -1.3, 0.2, 0.2, 0.1],
}


def study_of(name, saturation=None, period=1e-3, friction=0.0, **ranges):
    """A study of an arm with a tool of unknown length, with its gravity."""
    ranges = {"object_length": (0.0, 0.06), "object_axis": "x"} | ranges
    if name == "two_link":
        ranges["task"] = PLANE
    errors = aj.Uncertainty(aj.load_robot(name), friction=friction, **ranges)
    task, latency = errors.believed_task(), Latency(period)
    controller = aj.SetpointController(task, latency=latency)
    if saturation is not None:
        controller = aj.SetpointController(task, controller.gains, saturation=saturation)
    region = aj.JointBox.around(errors.arm, STARTS[name], 0.2)
    return aj.Study(controller, errors, region, latency=latency)


class Run:
    """A run of one true robot along a move, and how far it gets from its slow path."""

    def __init__(self, study, start, move, values):
        length = np.linalg.norm(move.displacement)
        self.line = EasedLine(move.displacement / length, length, move.speed)
        plant, dt = study.uncertainty.plant(values), study.timing.period
        x0, duration = plant.sensor.value(start), dt * round((move.duration + 1.0) / dt)
        way = Path(x0, x0 + move.displacement, move.duration)
        run = aj.simulate(plant, study.controller, way, start, duration, dt=dt)
        loop, truths = study.loop().of_values(np.asarray(values)[None])
        path, _ = slow_path(loop, truths, start, self.line)
        r = np.minimum(run.t / move.duration, 1.0)
        share = r**3 * (10.0 - 15.0 * r + 6.0 * r * r)
        motion = between(np.repeat(path, len(r), 1), share)
        moved = np.array([motion_between(plant.robot, start, q) for q in run.q])
        self.e = np.linalg.norm(run.error, axis=1).max()
        self.away = np.abs(moved - motion).max(axis=0)
        self.speed = 16.0 * move.speed * r**2 * (1.0 - r) ** 2
        self.loop, self.truths, self.run = loop, truths, run


def shares(study, start, moves, robots):
    """The worst |e| and joints of runs as shares of their bounds."""
    return [
        (run.e / move.error, (run.away / move.deviation).max())
        for move in moves
        for run in (Run(study, start, move, values) for values in robots)
    ]


def test_a_two_link_moves_as_promised_and_too_fast_a_move_is_refused():
    study = study_of("two_link", law.Tanh(0.05), friction=0.3)
    start = np.array([0.4, 1.3])
    found = study.moves([[0.1, 0.1], [0.0, -0.15]], start=start, speed=0.05)
    robots = study.uncertainty.corners()
    for e, joints in shares(study, start, found.moves, robots):
        assert 0.05 < e < 1.0
        assert joints < 1.0
    assert "certified" in str(found)
    assert "not proven" in str(found)
    (refused,) = study.moves([0.1, 0.1], start=start, speed=3.0).moves
    assert refused.speed == 0.0
    assert refused.reason in str(refused)
    assert refused.reason


@pytest.mark.parametrize("speed", [0.1, 0.02])  # where inertia drives e, and where δ does
def test_v_and_the_energy_of_a_run_are_within_the_bounds_of_its_own_constants(speed):
    """Lemma 3, with the constants of the run itself, so that it is not loose."""
    study, start = study_of("ur5", law.Tanh(0.02)), np.array(STARTS["ur5"])
    move = type("Asked", (), {"displacement": np.array([0.0, 0.12, 0.05]), "speed": speed})
    move.duration = 1.875 * np.linalg.norm(move.displacement) / move.speed
    run = Run(study, start, move, study.uncertainty.corners()[-1])
    record, every = run.run, slice(0, None, 10)
    q, x_d, v = record.q[every], record.x_d[every], record.v[every]
    samples = run.loop.samples_at(np.repeat(run.truths, len(q)), q, x_d)
    hold, friction = Hold.of(study.timing), run.loop.plants[0].friction
    form = MovingForm(samples, run.loop.setting, friction, hold, run.line, 1.0)
    nu = v - run.speed[every, None] * form.motion.r
    fastest = np.sqrt(np.einsum("ni,nij,nj->n", nu, samples.M, nu).max())
    form = MovingForm(samples, run.loop.setting, friction, hold, run.line, 1.01 * fastest)
    form = form.changed(decay=(1.1, 0.52))
    weights = best_weights(form, "free").weights
    tube = Tube(np.full(6, 0.1), run.e, fastest)
    on = form.along(weights, tube, form.most | largest(form.weighed(weights)))
    G, s = form.cross_weight(weights), samples.s
    V = 0.5 * np.einsum("ni,nij,nj->n", nu, samples.M, nu) + weights.at_rest(
        samples.e, study.controller.saturation
    )
    V += np.einsum("ni,nij,njk,nk->n", nu, samples.M, G, s)
    t = record.t[every]
    bound = np.interp(t, np.linspace(0.0, move.duration, len(on.Y)), on.Y)
    while_moving = t <= move.duration
    ratio = np.sqrt(2.0 * V)[while_moving][5:] / bound[while_moving][5:]
    assert 0.2 < ratio.max() < 1.0
    D = law.dissipation(samples.J_hat, run.loop.setting.kv, run.loop.setting.B)
    assert np.trapezoid(np.einsum("ni,nij,nj->n", nu, D, nu), t) < on.energy
    assert np.abs(s).max() < np.abs(on.s).max()


def bounds_along(name, rate):
    """The form of an arm in a tube, its largest constants and what they bound."""
    study, start = study_of(name, friction=0.3), np.array(STARTS[name])
    d = np.array([0.6, 0.8, 0.0][: study.controller.task.m])
    loop, line = study.loop(), EasedLine(d, 0.1, 0.1)
    tube = Tube(np.full(len(start), 0.02), 0.004, 0.1)
    box = TubeBox(loop, line, start, tube)
    samples, _ = box.samples(box.starts(30, np.random.default_rng(0)))
    hold, friction = Hold.of(study.timing), loop.plants[0].friction
    form = MovingForm(samples, loop.setting, friction, hold, line, tube.nu)
    form = form.changed(decay=(rate, 0.52))
    weights = best_weights(form, "free").weights
    most = form.most | largest(form.weighed(weights))
    return form, most, form.along(weights, tube, most)


@pytest.mark.parametrize("rate", [0.7, 1.5])
def test_what_is_left_at_the_end_of_a_move_counts_until_it_has_died_out(rate):
    """∫s² over all time, of the product s n by Cauchy and Schwarz: after the end s ~ exp(−ρt)."""
    form, _, on = bounds_along("two_link", rate)
    dt = form.line.duration / (len(on.s) - 1)
    after = on.s[-1] * np.exp(-rate * np.arange(0.0, 10.0 / rate, dt))
    moving, falling = np.trapezoid(on.s**2, dx=dt), np.trapezoid(after**2, dx=dt)
    assert falling > 0.05 * moving
    assert on.s_n**2 > 0.999 * on.energy * (moving + falling)
    assert on.n > 1.1 * np.sqrt(on.energy * form.line.duration)  # the bound of ∫n of the move alone


def test_whatever_drives_a_joint_off_its_path_is_counted():
    """Each constant that is larger makes the bounds of some joint larger."""
    form, most, on = bounds_along("ur5", 1.0)  # whose joints move as they like besides
    of_none = {"r", "turning", "gravity of M", "along", "margin", "flat", "sigma", "delta"}
    names = [name for name in most if name not in of_none and name[:-1] not in ("f", "psi")]
    usual = form.drift(on, most)
    for name in names:
        more = form.drift(on, most | {name: 2.0 * most[name]})
        assert (more >= usual).all()
        assert (more > usual * (1.0 + 1e-9)).any(), name


def test_speed_counts_in_the_norm_of_energy_and_slower_moves_have_smaller_bounds():
    study, start = study_of("two_link", friction=0.3), np.array(STARTS["two_link"])
    loop, line = study.loop(), EasedLine(np.array([0.0, -1.0]), 0.15, 0.02)
    found = MoveSearch(loop, 1e-3, start, np.random.default_rng(0)).certified(line, False)
    tube, weights, rate = found.tube, found.function.weights, found.function.rate
    samples, _ = TubeBox(loop, line, start, tube).samples(
        np.random.default_rng(1).uniform(-1.0, 1.0, (100, 6))
    )
    hold, friction = Hold.of(study.timing), loop.plants[0].friction
    bounds = []
    for share in (1.0, 0.3, 0.1, 0.01):
        slower = line._replace(peak=share * line.peak)
        form = MovingForm(samples, loop.setting, friction, hold, slower, tube.nu)
        form = form.changed(decay=(rate, 0.5))
        bounds.append(form.bounds(weights, tube, largest(form.weighed(weights))))
    for faster, slower in itertools.pairwise(bounds):
        assert faster.holds(slower)
    r = form.motion.r
    assert form.sizes()["r"] == pytest.approx(
        np.sqrt(np.einsum("ni,nij,nj->n", r, samples.M, r)), rel=1e-9
    )


def test_paths_and_errors_of_a_tube_are_those_asked_for():
    study = study_of("ur5")
    loop, line = study.loop(), EasedLine(np.array([0.0, 0.6, 0.8]), 0.15, 0.1)
    box = TubeBox(loop, line, np.array(STARTS["ur5"]), Tube(np.full(6, 0.02), 0.004, 0.1))
    z = box.starts(60, np.random.default_rng(0))
    samples, rows = box.samples(z)
    assert len(rows) == 60
    given = z[:, -3:] * 0.004 / np.maximum(1.0, np.linalg.norm(z[:, -3:], axis=1))[:, None]
    assert np.abs(samples.e - given).max() < 1e-4
    z[:, 2:] = 0.0
    for share in (-1.0, 0.3, 1.0):  # with joints and errors at 0: the path goes through x_d
        z[:, 1] = share
        on_it, _ = box.samples(z)
        assert np.abs(on_it.e).max() < 1e-7
    other, truths = loop.of_values(loop.corners[:1])
    path, _ = slow_path(other, truths, np.array(STARTS["ur5"]), line)
    end = other.terms(truths, STARTS["ur5"] + path[-1, :, :6])
    begin = other.terms(truths, np.array([STARTS["ur5"]]))
    assert np.linalg.norm(end.x - begin.x - line.length * line.d) < 2e-5


def test_joints_between_the_path_and_the_tube_count_in_how_the_path_turns():
    study = study_of("z1")
    start, line = np.array(STARTS["z1"]), EasedLine(np.array([0.0, 0.0, 1.0]), 0.12, 0.05)
    search = MoveSearch(study.loop(), 1e-3, start, np.random.default_rng(0))
    box = TubeBox(study.loop(), line, start, Tube(np.full(6, 0.1), 0.005, 0.2))
    z = box.starts(50, np.random.default_rng(1))
    path, halfway, whole = (box.samples(z, part)[0] for part in (0.0, 0.5, 1.0))
    assert halfway.q == pytest.approx(0.5 * (path.q + whole.q))
    form = search._form(box, z)
    several = form.elsewhere(box.samples(z[::5], 0.5)[0])
    for name in ("dh", "along"):
        assert (form.most[name] >= largest(several.sizes())[name]).all()
        assert (form.most[name] >= largest(form.sizes())[name]).all()


def test_a_tube_holds_another_only_if_all_of_it_is_inside():
    tube = Tube(np.array([0.1, 0.2]), 0.01, 0.3)
    assert tube.holds(Tube(0.9 * tube.R, 0.009, 0.2))
    for other in (Tube(np.array([0.05, 0.2]), 0.009, 0.2), tube._replace(R=0.5 * tube.R)):
        assert not tube.holds(other)
    assert not tube.holds(Tube(0.9 * tube.R, 0.009, 0.3))


def test_what_the_theorem_does_not_cover_is_refused_with_what_would_be():
    study = study_of("ur5")
    late = aj.Study(study.controller, study.uncertainty, study.region, latency=Latency(1e-3, 1e-3))
    with pytest.raises(aj.InvalidInputError, match="latency must have no more than a period"):
        late.moves()
    learning = aj.SetpointController(
        study.controller.task, gravity=aj.AdaptiveGravity(study.controller.task.robot)
    )
    with pytest.raises(aj.InvalidInputError, match="gravity must be known"):
        aj.Study(learning, study.uncertainty, study.region).moves()
    with pytest.raises(aj.InvalidInputError, match="must not be zero"):
        study.moves([0.0, 0.0, 0.0])


@pytest.mark.study
def test_a_search_finds_worse_than_samples_and_the_answer_has_it():
    study = study_of("two_link", object_length=(0.0, 0.1), believed_length=0.05)
    search = MoveSearch(study.loop(), 1e-3, np.array(STARTS["two_link"]), np.random.default_rng(0))
    line = EasedLine(np.array([0.0, 1.0]), 0.2, 0.06)
    sampled, searched = search.certified(line, False), search.certified(line, True)
    assert not len(sampled.hard)
    assert len(searched.hard)
    assert searched.tube.e > 0.9 * sampled.tube.e


@pytest.mark.study
@pytest.mark.every_arm
@pytest.mark.parametrize("name", ["baxter_left_arm", "z1"])  # that nothing was tuned on
def test_arms_that_nothing_was_tuned_on_move_as_promised(name):
    study, start = study_of(name, friction=0.2), np.array(STARTS[name])
    found = study.moves(0.15 * np.array([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0]]))
    certified = [move for move in found.moves if not move.reason]
    assert certified
    errors, rng = study.uncertainty, np.random.default_rng(3)
    robots = [*errors.corners(), *(errors.sample(rng) for _ in range(3))]
    worst = np.max(shares(study, start, certified, robots), axis=0)
    assert (worst < 1.0).all()
    assert math.isfinite(worst[0])
    assert worst[0] > 0.05
