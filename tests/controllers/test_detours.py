"""Detours of the tracking law: a motion of the joints that leaves a dead end."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import law
from approxjac.controllers import TrackingGains
from approxjac.scenario import Scenario, build_scenario, recommended, run_scenario

DT = 4e-3
ROBOT = aj.load_robot("so101")
START = ROBOT.configuration((-0.878, 1.352, 1.093, 0.141, -2.699))
GOAL = (-0.088, 0.292, 0.305, 0.068, -2.5)  # behind a dead end of the straight way


def walk(seconds, target, detours=True, of=None, moves=lambda t: None):
    """Positions of joints that follow the reference, their errors, and the law's last state."""
    task = aj.PositionTask(ROBOT)
    known = aj.controllers.KnownKinematics(task)
    tracks = aj.TrackingController(
        task, kinematics=known, dt=DT, gains=TrackingGains(detours=detours)
    )
    steps = tracks if of is None else of(tracks)
    (low, high), q, v = ROBOT.position_limits, START, np.zeros(5)
    state, places, errors = tracks.begin(aj.Measurement(0.0, q, v, task.value(q))), [], []
    for k in range(round(seconds / DT)):
        x = task.value(q)
        aim = aj.Target(target, moves(k * DT))
        state, answer = steps.advance(state, aj.Measurement(k * DT, q, v, x), aim, DT)
        after = np.clip(q + DT * answer.reference, low, high)
        q, v = after, (after - q) / DT
        places.append(q)
        errors.append(np.linalg.norm(x - target))
    return np.array(places), np.array(errors), state


@pytest.fixture(name="target")
def _target():
    return aj.PositionTask(ROBOT).value(ROBOT.configuration(GOAL))


def test_an_arm_leaves_a_dead_end(target):
    """Without detours it stands there; with them it is at its target soon after."""
    _, stands, _ = walk(4.0, target, detours=False)
    assert stands[-1] > 0.3
    assert stands[-250:].max() - stands[-250:].min() < 1e-3
    places, errors, _ = walk(4.0, target)
    assert errors[-1] < 1e-5
    low, high = ROBOT.position_limits
    assert ((places > low) & (places < high))[-1].all()


def test_up_to_the_dead_end_nothing_changes(target):
    with_them, without = (walk(0.5, target, detours=detours)[0] for detours in (True, False))
    assert np.array_equal(with_them, without)


def test_a_target_that_moves_is_followed_without_detours(target):
    crawls = walk(3.0, target, moves=lambda t: np.full(3, 1e-9))[1]
    assert crawls[-1] > 0.3


def test_compiled_it_is_the_same(target):
    places, *_ = walk(1.6, target)
    compiled, *_ = walk(1.6, target, of=aj.codegen.compiled)
    assert_allclose(compiled, places, atol=1e-9)


def detour(dt=1e-3, turns=0.0, end=2.0):
    """A detour of three joints that are the task."""
    ones = np.ones(3)
    spread = np.array([0.8, 0.6, 0.5])
    return law.Detour(-end * ones, end * ones, turns * ones, spread, ones, ones, 0.05, dt)


@pytest.mark.parametrize("before", [0.005, 0.03, 0.1])
def test_a_target_that_changes_during_the_search_ends_it(before):
    """What was found is of the target before: nothing moves."""
    ways, goal, motion = detour(4e-3), np.array([0.5, -1.0, 0.2]), np.zeros(3)

    def begins(change, stands):
        memory = np.zeros(ways.size)
        for k in range(400):
            aim = goal - 1.0 if k * ways.dt >= change else goal
            memory, h, *_ = ways.step(
                memory, stands or k * ways.dt < change, motion, aim,
                lambda place, aim=aim: (place - aim, np.eye(3)),
            )  # fmt: skip
            if h > 0.0:
                return k * ways.dt
        return np.inf

    usual = begins(9.0, True)
    assert 0.2 < usual < 0.6
    assert begins(usual - before, False) == np.inf
    assert begins(usual - before, True) > usual - before + 0.2


def test_the_shortest_way_of_a_continuous_joint_is_over_its_seam():
    ways, motion = detour(turns=1.0, end=np.pi), np.full(3, 3.0)
    goal, memory, moved = np.full(3, -3.0), np.zeros(ways.size), np.zeros(3)
    for k in range(1200):
        memory, h, _, speed = ways.step(
            memory, k < 500, motion, goal, lambda place: (np.sin(place - goal), np.eye(3))
        )
        moved = moved + ways.dt * h * speed
    assert_allclose(moved, 2.0 * np.pi - 6.0, atol=0.02)


@pytest.mark.parametrize("away", [2.0, -2.6])
def test_the_way_of_a_continuous_joint_is_less_than_half_a_turn(away):
    ways, memory, moved = detour(2e-3, turns=1.0, end=np.pi), np.zeros(detour().size), np.zeros(3)
    goal = np.array([away, 0.4, -0.5 * away])

    def look(place):
        return np.arctan2(np.sin(place - goal), np.cos(place - goal)), np.eye(3)

    for k in range(3000):
        memory, h, _, speed = ways.step(memory, k < 250, np.zeros(3), goal, look)
        moved = moved + ways.dt * h * speed
    assert_allclose(moved, goal, atol=0.03)


@pytest.mark.parametrize("near", [0.35, -0.5])
def test_of_several_configurations_the_soonest_is_taken(near):
    """Two reach the target, and starts of the search are nearer to the far one, too."""
    ways, memory, moved = detour(3e-3), np.zeros(detour().size), np.zeros(3)
    goals = np.array([[near, 0.1, 0.2], [-2.6 * near, -0.7, -0.4]])

    def look(place):
        away = place - goals
        return away[np.argmin(np.abs(away).max(axis=1))], np.eye(3)

    for k in range(900):
        memory, h, _, speed = ways.step(memory, k < 300, np.zeros(3), np.ones(3), look)
        moved = moved + ways.dt * h * speed
    assert_allclose(moved, goals[0], atol=0.02)


@pytest.mark.parametrize("c", [0.4, 1.0])
def test_the_torque_is_that_of_the_motion_it_takes(rng, c):
    """On its ramp, and in the middle, where joints keep their speed: q̈_r is the rate of q̇_r."""
    ur10, dt = aj.load_robot("ur10"), 1e-5
    task, dynamics = aj.PositionTask(ur10), aj.robots.Dynamics(ur10)
    tracks = aj.TrackingController(
        task, kinematics=aj.controllers.KnownKinematics(task), dt=dt,
        dynamics=aj.controllers.ModelDynamics(ur10), gains=TrackingGains(detours=True),
    )  # fmt: skip
    q, still, way = np.array([0.3, -1.1, 1.4, -0.8, -1.2, 0.5]), np.zeros(6), rng.normal(size=6)
    goal = task.value(q) + [0.2, -0.3, 0.1]
    begun = tracks.begin(aj.Measurement(0.0, q, still, task.value(q)))
    under_way = [0.0, 0.0, 0.0, 1e9, 1.0, 2.0, c, *goal, *q, *still, *way]  # as `Detour` has it
    begun[-len(under_way) :] = under_way

    def step(state, q, v):
        now = aj.Measurement(0.0, q, v, task.value(q))
        return tracks.advance(state, now, aj.Target(goal), dt)

    v = step(begun, q, still)[1].reference
    after, answer = step(begun, q, v)
    rate = (step(after, q + dt * v, v)[1].reference - v) / dt
    a = dynamics.forward(q, v, answer.torque)
    assert_allclose(a, rate, atol=1e-3 * max(1.0, np.abs(rate).max()))
    assert (np.abs(rate).max() > 0.5) == (c < 1.0)


def test_where_nothing_is_seen_is_no_way():
    ways, goal, memory = detour(), np.array([0.5, -1.0, 0.2]), np.zeros(detour().size)
    for _ in range(900):
        memory, h, *_ = ways.step(
            memory, True, np.zeros(3), goal,
            lambda place: (np.where(place[0] > 0.1, np.nan, place - goal), np.eye(3)),
        )  # fmt: skip
        assert np.isfinite(memory).all()
        assert h == 0.0


@pytest.mark.parametrize("changes", [False, True])
def test_its_way_is_the_integral_of_its_speed(changes):
    """ḣ is the rate of h, and both end at zero; a new target ends it at once."""
    ways, goal, motion = detour(), np.array([0.5, -1.0, 0.2]), np.zeros(3)
    memory, rows, moved = np.zeros(ways.size), [], np.zeros(3)
    for k in range(3000):
        aim = goal + (0.1 if changes and k > 700 else 0.0)
        memory, h, h_dot, speed = ways.step(
            memory, k < 500, motion, aim, lambda place: (place - goal, np.eye(3))
        )
        rows.append((h, h_dot))
        moved = moved + ways.dt * h * speed
    h, h_dot = np.array(rows).T
    assert_allclose(np.gradient(h, ways.dt), h_dot, atol=0.06)
    assert h.max() == 1.0
    assert h[-1] == h_dot[-1] == 0.0
    assert (np.abs(moved - goal).max() < 0.02) != changes
    assert np.flatnonzero(h)[-1] * ways.dt < (1.1 if changes else 2.2)


@pytest.mark.parametrize(("speed", "stands"), [(0.0, True), (0.02, True), (-0.5, False)])
def test_an_arm_stands_that_comes_hardly_nearer(speed, stands):
    z, J = np.array([0.1, 0.0, 0.0]), np.eye(3)
    assert bool(detour().stands(z, J, speed * np.eye(3)[0], 6.0)) == stands
    assert not detour().stands(0.1 * z, J, np.zeros(3), 6.0)  # it is as good as there


@pytest.mark.parametrize("place", [5.0, 2.05])
def test_where_nothing_is_found_within_the_ranges_it_does_not_move(place):
    ways, memory = detour(), np.zeros(detour().size)
    far = np.full(3, place)
    for _ in range(2000):
        memory, h, *_ = ways.step(
            memory, True, np.zeros(3), far, lambda place: (place - far, np.eye(3))
        )
        assert h == 0.0
    assert np.isfinite(memory).all()


def test_what_it_is_not_for_is_refused():
    ur3 = aj.load_robot("ur3")
    for task, command in ((aj.PoseTask(ur3), "torque"), (aj.PositionTask(ur3), "velocity")):
        with pytest.raises(aj.errors.InvalidInputError, match="detours"):
            aj.TrackingController(task, command=command, gains=TrackingGains(detours=True))
    given = {"law": "setpoint", "detours": True}
    with pytest.raises(aj.errors.InvalidInputError, match="detours"):
        build_scenario(Scenario("so101", controller=given))


@pytest.mark.study
def test_a_simulation_takes_them():
    true = {"object": {"length": 0.1, "mass": 0.1}}
    run = {"start": "random", "duration": 3.0, "seed": 602}
    scenario = recommended(Scenario("so101", true=true, run=run))
    assert scenario.controller.detours
    assert run_scenario(scenario).final_error["m"] < 2e-3
    without = recommended(Scenario("so101", controller={"detours": False}))
    assert (without.controller.law, without.controller.detours) == ("tracking", False)


@pytest.mark.parametrize("end", [-2.0, 2.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_where_a_joint_is_at_its_end_the_others_do_the_step(end, side):
    """That of Gauss and Newton; inwards, the joint does its share."""
    motion, J, z = np.array([end, 0.3, 0.0]), np.array([[1.0, 1.0, 0.5]]), np.array([0.45 * side])
    step = detour()._nearer(motion, z, J) - motion
    free = J[0].copy()
    free[0] *= side * end > 0.0  # it moves by −z
    assert_allclose(step, -z[0] * free / (free @ free), rtol=1e-3, atol=1e-12)
