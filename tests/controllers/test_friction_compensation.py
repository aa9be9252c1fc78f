"""Joints that rub: the compensation's statement, what it learns, and that nothing hunts."""

import functools

import numpy as np
import pinocchio as pin
import pytest

import approxjac as aj
from approxjac import law
from approxjac.controllers import FrictionCompensation
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.robots import Drives, Friction
from approxjac.simulation import Computation

UR10E = Friction(
    (27.9, 19.2, 10.8, 3.2, 2.4, 3.1), (20.9, 19.5, 7.6, 2.9, 3.5, 2.8), stribeck=1.3, load=0.06
)


def setpoint(task, learns=True, **options):
    gravity = aj.AdaptiveGravity(task.robot) if learns else None
    return aj.SetpointController(task, gravity=gravity, **options)


@functools.cache
def rule(name="panda"):
    task = aj.PositionTask(aj.load_robot(name))
    return setpoint(task, friction=FrictionCompensation())._rubs


# -- the statement -------------------------------------------------------------------------------


def test_what_it_adds_to_the_rate_of_V_is_bounded():
    # F_i of friction in F_i Sgn(q̇_i), and F̂ = F: y (F̂ψ − f) <= 0.2785 Σ ε F, whatever moves
    rng, of = np.random.default_rng(3), rule()
    n, worst = len(of.width), 0.0
    for _ in range(4000):
        F = rng.uniform(0.0, 1.0, n) * of.most
        nu = of.width * rng.normal(size=n) * 10.0 ** rng.uniform(-2.0, 2.0, n)
        v = nu * rng.choice([0.0, 0.3, 0.9, 1.1, 3.0, -1.0], n)
        memory = np.concatenate([F, np.zeros(n + 1)])
        torque, _, _ = law.friction_step(of, memory, v, nu, np.ones(3), False)
        sliding = np.where(v == 0.0, rng.uniform(-1.0, 1.0, n), np.sign(v))
        added = (v - nu) @ (torque - F * sliding)
        worst = max(worst, added / (of.width @ F))
    assert 0.1 < worst <= 0.2785


def test_only_what_stands_and_should_move_learns():
    of = rule()
    n = len(of.width)
    memory = np.concatenate([0.1 * of.most, np.ones(n), [0.0]])
    nu = 3.0 * of.width
    stands = law.friction_step(of, memory, np.zeros(n), nu, np.ones(3), False)
    assert (stands[1][:n] > 0.0).all()
    assert stands[2]  # gravity does not learn from that
    as_wanted = law.friction_step(of, memory, nu, nu, np.ones(3), False)
    assert (as_wanted[1][:n] == 0.0).all()
    assert not as_wanted[2]
    ahead = law.friction_step(of, memory, 2.0 * nu, nu, np.ones(3), False)
    assert (ahead[1][:n] < 0.0).all()
    near = law.friction_step(of, memory, np.zeros(n), nu, 0.5 * of.fine, False)
    assert (near[1][:n] == 0.0).all()
    assert near[1][-1] > 0.0


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_it_is_half_way_where_errors_that_are_fine_ask_for_little(name):
    """tanh(ν/ε) with ε = ‖ν‖ of them in the median, by the law's own Ĵ⁺."""
    law_ = setpoint(aj.PositionTask(aj.load_robot(name)), friction=FrictionCompensation())
    of, weight = law_._rubs, np.sqrt(law_.adaptation.pinv_weight)
    assert np.ptp(weight) > 0.5
    nu = [
        law_.alpha * np.linalg.norm(law_.pinv.matrix(J) * 2.0 * of.fine, axis=1)
        for J in sample_configurations(law_.task).J_hat
    ]
    nu, wide = np.median(nu, axis=0), of.width > 1.001 * of.width.min()
    assert wide.sum() >= 4
    np.testing.assert_allclose(of.width[wide], nu[wide])


def test_a_joint_stands_once_it_was_slow_for_40_ms_and_anew_after_it_moved():
    of = rule()
    n, nu, grew = len(of.width), 3.0 * of.width, []
    memory = np.concatenate([0.1 * of.most, np.zeros(n + 1)])
    for k in range(300):
        v = nu if 100 <= k < 200 else np.zeros(n)
        _, rate, _ = law.friction_step(of, memory, v, nu, np.ones(3), False)
        memory = memory + 1e-3 * rate
        grew.append((rate[:n] > 0.0).all())
    assert abs(grew.index(True) - 40) <= 1
    assert not any(grew[100:239])
    assert all(grew[42:100] + grew[242:])


def test_all_rests_near_the_target_until_it_is_left():
    of = rule()
    n = len(of.width)
    quiet = np.concatenate([0.1 * of.most, np.ones(n), [1.0]])
    for share, rests in ((0.5, True), (1.5, True), (2.5, True)):
        _, rate, held = law.friction_step(of, quiet, np.zeros(n), of.width, share * of.fine, False)
        assert bool(held) is rests
        assert (rate[-1] < 0.0) == (share > 2.0)
    full = np.concatenate([of.most, np.ones(n), [0.0]])  # or a weight could never be learnt
    assert not law.friction_step(of, full, np.zeros(n), of.width, np.ones(3), False)[2]


@pytest.mark.parametrize("lost", [False, True])
def test_it_stays_within_its_bounds(lost):
    of = rule()
    n = len(of.width)
    memory = np.concatenate([of.most, np.ones(n + 1)])
    torque, rate, _ = law.friction_step(of, memory, np.zeros(n), 1e9 * of.width, np.ones(3), lost)
    assert (np.abs(torque) <= of.most).all()
    assert (rate[:n] <= 0.0).all()
    nothing = np.concatenate([-1e-9 * of.most, np.zeros(n + 1)])
    assert (
        law.friction_step(of, nothing, 1.0 + of.width, of.width, np.ones(3), False)[0] >= 0
    ).all()


# -- the law -------------------------------------------------------------------------------------


def test_the_torque_without_friction_learnt_is_that_of_the_law():
    task = aj.PositionTask(aj.load_robot("ur5"))
    plain, rubs = setpoint(task), setpoint(task, friction=FrictionCompensation())
    rng = np.random.default_rng(0)
    q, v = task.robot.random_configuration(rng), rng.normal(size=6)
    at = aj.Measurement(0.0, q, v, task.value(q))
    x_d = task.value(q) + 0.1
    known = FrictionCompensation(Friction(coulomb=2.0))
    told = setpoint(task, friction=known)
    a, b, c = (each.evaluate(each.begin(at), at, x_d) for each in (plain, rubs, told))
    assert np.array_equal(a.torque, b.torque)
    nu = -told.alpha * told.pinv.times(a.J_hat, told.saturation.s(a.e))
    np.testing.assert_allclose(
        c.torque - a.torque, 1.6 * np.tanh(nu / told._rubs.width), atol=1e-12
    )


def test_no_more_is_told_of_friction_than_may_act():
    task = aj.PositionTask(aj.load_robot("ur5"))
    q = task.robot.neutral()
    at = aj.Measurement(0.0, q, np.zeros(6), task.value(q))
    told = setpoint(task, friction=FrictionCompensation(Friction(coulomb=5.0), most=3.0))
    assert told.learnt(told.begin(at))[-6:].tolist() == [3.0] * 6


def test_its_numbers_have_names_and_outlive_a_run():
    task = aj.PositionTask(aj.load_robot("panda"))
    rubs = setpoint(task, friction=FrictionCompensation())
    assert rubs.parameters["friction of panda_joint2"] == "N m"
    assert "friction" in str(rubs)
    q = task.robot.neutral()
    at = aj.Measurement(0.0, q, np.zeros(7), task.value(q))
    state = rubs.initial_state(at)
    assert len(rubs.learnt(state)) == len(rubs.parameters)
    state[len(rubs.parameters) - 7 : len(rubs.parameters)] = 1.0
    assert rubs.learnt(rubs.resumed(state, at))[-7:].tolist() == [1.0] * 7
    assert rubs.with_task(task).friction is rubs.friction


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"known": 2.0}, "known must be"),
        ({"fine": -1e-3}, "fine must be"),
        ({"most": [1.0, 2.0]}, "most must have shape"),
        ({"encoder_step": -1.0}, "encoder_step must be"),
    ],
)
def test_wrong_numbers_are_named(given, what):
    task = aj.PositionTask(aj.load_robot("panda"))
    with pytest.raises(aj.InvalidInputError, match=what):
        setpoint(task, friction=FrictionCompensation(**given))
    with pytest.raises(aj.InvalidInputError, match="friction must be FrictionCompensation"):
        setpoint(task, friction=Friction())


def test_certificates_are_of_joints_that_do_not_rub():
    robot = aj.load_robot("two_link")
    task = aj.PositionTask(robot, axes="xz")
    law_of = functools.partial(setpoint, task)
    plain, rubs = (
        aj.Study(each, robot).report(40)
        for each in (law_of(), law_of(friction=FrictionCompensation()))
    )
    assert plain.growth.rate == rubs.growth.rate
    assert plain.test.margin == rubs.test.margin
    told = law_of(friction=FrictionCompensation(Friction(coulomb=1.0)))
    with pytest.raises(aj.InvalidInputError, match="given a friction"):
        aj.Study(told, robot).loop()


def test_the_tracking_law_begins_with_a_friction_that_is_told():
    task = aj.PositionTask(aj.load_robot("panda"))
    told = aj.TrackingController(task, friction=Friction(2.0, 5.0))
    q = task.robot.neutral()
    at = aj.Measurement(0.0, q, np.zeros(7), task.value(q))
    learnt = dict(zip(told.parameters, told.learnt(told.initial_state(at)), strict=True))
    assert learnt["panda_joint1.viscous"] == 2.0
    assert learnt["panda_joint1.coulomb"] == 4.0
    with pytest.raises(aj.InvalidInputError, match="friction must be"):
        aj.TrackingController(task, friction=2.0)


# -- runs ----------------------------------------------------------------------------------------


def figures(run, since=10.0):
    """Return the rms error [mm] and how often joints turned, from some time on."""
    late = run.t >= since
    turns = 0
    for speed in run.v[late].T:
        signs = np.sign(speed[np.abs(speed) > 1e-3])
        turns += int((signs[1:] != signs[:-1]).sum())
    return 1e3 * float(np.sqrt((run.error_norm[late] ** 2).mean())), turns


def reached(name, friction, seed, *, compensation=None, learns=True, drives=None, duration=20.0):
    """Reach with an unknown tool of 15 cm and 2 kg, or a known one where gravity is known."""
    robot, rng = aj.load_robot(name), np.random.default_rng(seed)
    truth = robot.with_object(0.15, 2.0, axis="xz"[seed % 2])
    plant = aj.Plant(truth, friction=friction, drives=drives)
    task = aj.PositionTask(robot.with_object(0.0) if learns else truth)
    q0 = plant.ready_configuration()
    target = plant.sensor.value(pin.integrate(robot.model, q0, rng.normal(0.0, 0.25, robot.nv)))
    controller = setpoint(task, learns, friction=compensation)
    computation = Computation("semi_implicit_euler", engine="compiled")
    return aj.simulate(plant, controller, target, q0, duration, computation=computation)


def share_of_effort(name, share):
    dry = share * aj.load_robot(name).effort_limits
    return Friction(0.5 * dry, dry, stribeck=1.3)


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "friction"),
    [
        ("ur10", UR10E),
        ("z1", 0.10),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("ur3", 0.05), ("kinova", 0.05), ("baxter_left_arm", 0.10))
        ),
    ],
)
def test_joints_that_rub_hold_still(name, friction):
    if not isinstance(friction, Friction):
        friction = share_of_effort(name, friction)
    for seed in (11, 12):
        run = reached(name, friction, seed, compensation=FrictionCompensation())
        error, turns = figures(run)
        assert error <= 0.3
        assert turns == 0
        holds, away = run.status == aj.Status.HOLDING, np.abs(run.error).max(axis=1)
        assert holds[-1] or away[-1] > 0.1e-3
        assert away[holds].max(initial=0.0) < 0.21e-3
        assert np.abs(run.v[holds]).max(initial=0.0) < 1e-3


@pytest.mark.study
def test_without_it_they_come_to_no_rest():
    errors = [figures(reached("ur10", UR10E, seed))[0] for seed in (11, 12)]
    assert min(errors) > 1.0


@pytest.mark.study
@pytest.mark.parametrize(
    "name",
    ["ur5", *(pytest.param(n, marks=pytest.mark.long) for n in ("panda", "baxter_left_arm"))],
)
def test_joints_that_do_not_rub_move_as_before(name):
    plain, rubs = (
        reached(name, Friction(), 13, compensation=each, duration=10.0)
        for each in (None, FrictionCompensation())
    )
    assert np.abs(plain.error_norm - rubs.error_norm).max() <= 1e-5
    assert aj.Status.HOLDING not in rubs.status


@pytest.mark.study
@pytest.mark.parametrize("name", ["panda", pytest.param("ur3", marks=pytest.mark.long)])
def test_with_known_gravity_it_brings_the_arm_to_its_target(name):
    friction = share_of_effort(name, 0.05)
    without = figures(reached(name, friction, 14, learns=False))[0]
    error, turns = figures(
        reached(name, friction, 14, learns=False, compensation=FrictionCompensation())
    )
    assert error <= 0.3
    assert turns == 0
    assert without > 5.0


@pytest.mark.study
def test_what_it_learns_is_of_the_size_of_friction():
    friction = share_of_effort("ur5", 0.05)
    run = reached("ur5", friction, 15, compensation=FrictionCompensation())
    static = 1.3 * np.asarray(friction.coulomb)
    controller = setpoint(aj.PositionTask(aj.load_robot("ur5")), friction=FrictionCompensation())
    found = controller.learnt(run.state[-1])[-6:]
    assert (found <= 1.5 * static).all()  # F̂ψ is what moves it
    assert (found[:3] >= 0.2 * static[:3]).all()


@pytest.mark.long
def test_on_what_kinematics_predict_springs_do_not_swing():
    # of a measured x, with what springs give way, a torque that turns with the error chatters
    robot = aj.load_robot("baxter_left_arm")
    truth = robot.with_object(0.15, 2.0, axis="x")
    friction = share_of_effort("baxter_left_arm", 0.05)
    plant = aj.Plant(truth, friction=friction, drives=Drives.usual(robot))
    task = aj.PositionTask(robot.with_object(0.0))
    controller = aj.controllers.PredictedMeasurement(
        setpoint(task, friction=FrictionCompensation()),
        aj.controllers.AdaptiveKinematics(task, noise=1e-4),
    )
    q0 = plant.ready_configuration()
    target = plant.sensor.value(q0 + np.random.default_rng(16).normal(0.0, 0.25, 7))
    computation = Computation("semi_implicit_euler", engine="compiled")
    error, turns = figures(
        aj.simulate(plant, controller, target, q0, 20.0, computation=computation)
    )
    assert error <= 0.3
    assert turns == 0


def followed(name, rubs, seed, **options):
    """Return the rms error [mm] on a circle from 2 s to 6 s, with an unknown tool."""
    robot = aj.load_robot(name)
    plant = aj.Plant(robot.with_object(0.15, 1.0, axis="x"), friction=rubs)
    task = aj.PositionTask(robot.with_object(0.0))
    law_of = aj.codegen.compiled(aj.TrackingController(task, **options))
    q0 = plant.ready_configuration()
    x0 = plant.sensor.value(q0)
    path = aj.Circle(2.0 * x0 - aj.Circle(x0, 0.1, 4.0).at(0.0).x, 0.1, 4.0)
    run = aj.simulate(
        plant, law_of, path, q0, 6.0, seed=seed, computation=Computation("semi_implicit_euler")
    )
    return 1e3 * float(np.sqrt((run.error_norm[run.t >= 2.0] ** 2).mean()))


@pytest.mark.long
@pytest.mark.parametrize(("name", "most"), [("ur3", 2.7), ("baxter_left_arm", 0.7)])
def test_the_tracking_law_follows_with_joints_that_rub(name, most):
    friction = share_of_effort(name, 0.05)
    learnt = followed(name, friction, 1)
    told = followed(name, friction, 1, friction=friction)
    assert max(told, learnt) <= most
