"""Laws of one's own: V along their runs, their linearisation, rollouts and limits."""

import functools
import sys
import types
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from own_controller import OwnController, TaskSpacePD, WindingUpNot
from scipy.linalg import expm

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity, Posture
from approxjac.stability.loop import linearization as local_module
from approxjac.stability.loop.linearization import LocalTest
from approxjac.stability.report.other_laws import near_targets

GOAL = np.array([0.5, 1.2])
PLANE = functools.partial(aj.PositionTask, axes="xz")


def two_link_loop(kind, dt=None, **options):
    arm = aj.load_robot("two_link")
    truth, belief = arm.with_object(0.2), arm.with_object(0.05)
    plant = aj.Plant(truth, aj.PositionTask(truth, axes="xz"), friction=0.3, **options)
    return plant, kind(aj.PositionTask(belief, axes="xz"))


def same(found, expected, rtol):
    """Each number that is expected is found."""
    assert len(found) == len(expected)
    for value in expected:
        assert np.abs(found - value).min() <= rtol * max(1.0, abs(value)), value


def numbers_of(plant, controller, q):
    """M, ∂g/∂q of truth and belief, J and Ĵ at q, by differences where there is no other way."""
    h, n = 1e-6, plant.robot.nv
    model, units = plant.robot.model, np.eye(n)
    believed = pin.Model(controller.task.robot.model)
    data = believed.createData()

    def slope(of):
        columns = [of(pin.integrate(model, q, h * u)) - of(pin.integrate(model, q, -h * u))
                   for u in units]  # fmt: skip
        return np.array(columns).T / (2.0 * h)

    G = slope(lambda at: plant.dynamics.g(at).copy())
    G_hat = slope(lambda at: pin.computeGeneralizedGravity(believed, data, at).copy())
    J, J_hat = slope(plant.sensor.value), slope(controller.task.value)
    return plant.dynamics.M(q), G, G_hat, J, J_hat


def test_the_spectrum_of_a_continuous_law_is_that_of_its_equations():
    plant, law = two_link_loop(TaskSpacePD)  # the tool weighs nothing: gravity is exact
    M, G, G_hat, J, J_hat = numbers_of(plant, law, GOAL)
    D = law.kd * J_hat.T @ J_hat + (law.damping + 0.3) * np.eye(2)
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:] = np.linalg.solve(M, np.hstack([G_hat - G - law.kp * J_hat.T @ J, -D]))
    local = aj.local_stability(plant, law, GOAL)
    same(local.eigenvalues, np.linalg.eigvals(A), 1e-6)
    assert (local.self_motion, local.unseen_parameters, local.singular) == (0, 0, False)
    assert local.stable
    assert str(local).startswith("stable: errors near the target die out at")


@pytest.mark.parametrize("late", [(0, 0, None), (3, 2, None), (1, 1, 0.004)])
@pytest.mark.parametrize("dt", [1e-3, 5e-3])
def test_the_spectrum_of_a_sampled_law_is_that_of_its_equations(late, dt):
    """Gravity is left to the integral: at the target it holds the arm."""
    x_late, torque_late, T = late
    sensing = aj.Sensing(x_delay=x_late * dt, velocity_filter=T)
    plant, law = two_link_loop(WindingUpNot, sensing=sensing, actuator_delay=torque_late * dt)
    M, G, _, J, J_hat = numbers_of(plant, law, GOAL)
    # of Ĵᵀ f, with which the integral f holds the arm, the slope counts, too
    f = np.linalg.solve(J_hat.T, plant.dynamics.g(GOAL))
    h, columns = 1e-6, []
    for unit in np.eye(2):
        more, less = (law.task.jacobian(GOAL + s * h * unit).T @ f for s in (1.0, -1.0))
        columns.append((more - less) / (2.0 * h))
    held = np.array(columns).T
    flow = np.zeros((6, 6))  # of δq, q̇ and a held torque
    flow[:2, 2:4] = np.eye(2)
    flow[2:4] = np.linalg.solve(M, np.hstack([-G, -0.3 * np.eye(2), np.eye(2)]))
    free = expm(dt * flow)
    n_w = 2 if T is not None else 0
    sizes = [2, 2, 2, n_w, 2 * x_late, 2 * torque_late]
    q, v, z, w, x_old, tau_old = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
    x_seen = np.vstack([x_old, J @ q])[:2]
    seen, w_after = v, w
    if T is not None:
        a = dt / (T + dt)
        seen = a / dt * q + w
        w_after = (1.0 - a) * seen - a / dt * q
    D = law.kd * J_hat.T @ J_hat + law.damping * np.eye(2)
    torque = J_hat.T @ (z - law.kp * x_seen) + held @ q - D @ seen
    acting = np.vstack([tau_old, torque])
    A = np.vstack([
        free[:4, :4] @ np.vstack([q, v]) + free[:4, 4:] @ acting[:2],
        z - law.ki * dt * x_seen, w_after, np.vstack([x_old, J @ q])[2:], acting[2:],
    ])  # fmt: skip
    local = aj.local_stability(plant, law, GOAL, dt)
    mu = np.linalg.eigvals(A)
    found = np.exp(dt * local.eigenvalues)
    assert len(found) == len(mu)
    for value in mu[np.abs(mu) > 0.3]:  # those that are over at once are not well conditioned
        assert np.abs(found - value).min() < 1e-6
    assert_allclose(np.log(np.abs(mu).max()) / dt, local.max_real_eigenvalue, rtol=1e-5)


@pytest.mark.parametrize(("gravity", "dt"), [(False, None), (True, None), (True, 2e-3)])
def test_differences_agree_with_the_equations_of_the_laws(gravity, dt):
    arm = aj.load_robot("panda")
    truth, belief = arm.with_object(0.2), arm.with_object(0.05, axis="x")
    options = {"actuator_delay": 4e-3, "sensing": aj.Sensing(x_delay=6e-3)} if dt else {}
    plant = aj.Plant(truth, friction=0.3, **options)
    learnt = aj.AdaptiveGravity(belief, L=1.0, alpha=2.0) if gravity else None
    law = aj.SetpointController(
        aj.PositionTask(belief), aj.Gains(60.0, 30.0, damping=1.0), gravity=learnt
    )
    q = truth.random_configuration(np.random.default_rng(1))
    expected = aj.local_stability(plant, law, q, dt)
    modes = local_module.numerical_stability(plant, law, q, local_module._timing(plant, dt))
    for name in ("self_motion", "unseen_parameters", "singular"):
        assert getattr(modes, name) == getattr(expected, name)
    lasting = expected.eigenvalues[expected.eigenvalues.real * (dt or 0.0) > -1.0]
    assert len(modes.eigenvalues) == len(expected.eigenvalues)
    for value in lasting:
        assert np.abs(modes.eigenvalues - value).min() < 1e-5 * max(1.0, abs(value))


def test_law_5_and_postures_are_linearised_too(panda):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    task, gains = aj.PositionTask(panda), aj.Gains(60.0, 30.0, damping=1.0)
    plain = aj.local_stability(aj.Plant(panda), aj.SetpointController(task, gains), q)
    quick = aj.SetpointController(task, gains, velocity=DifferentiatedVelocity(1e-4))
    found = aj.local_stability(aj.Plant(panda), quick, q)
    assert found.self_motion == plain.self_motion == 4
    assert_allclose(found.decay_rate, plain.decay_rate, rtol=1e-3)  # Ẋ is ẋ, nearly
    drawn = aj.SetpointController(task, gains, posture=Posture(q, 5.0))
    found = aj.local_stability(aj.Plant(panda), drawn, q)
    assert found.self_motion == 0  # the posture holds it
    assert found.stable


def test_an_arm_that_rests_far_along_its_self_motion_does_not_rest_there(panda):
    """Where a posture holds it at the same x, a radian away."""
    q, task = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]), aj.PositionTask(panda)
    x, far, way = task.value(q), q, np.eye(7)[0]
    while np.abs(far - q).max() < 1.0:
        J = task.jacobian(far)
        free = way - np.linalg.pinv(J) @ (J @ way)
        far = far + 0.02 * free / np.linalg.norm(free)
        far = far - np.linalg.pinv(J) @ (task.value(far) - x)
    law = aj.SetpointController(task, aj.Gains(60.0, 30.0, 1.0), posture=Posture(far, 5.0))
    assert aj.local_stability(aj.Plant(panda), law, far + 1e-3 * free).stable
    with pytest.raises(aj.InvalidInputError, match="must hold the arm at rest at the target"):
        aj.local_stability(aj.Plant(panda), law, q)


def test_what_only_limits_a_law_is_not_felt_near_the_target(panda):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    law = aj.SetpointController(aj.PositionTask(panda))
    expected = aj.local_stability(aj.Plant(panda), law, q, 1e-3).eigenvalues
    for around in (aj.TorqueLimited(law), aj.HeldMeasurement(aj.TorqueLimited(law), 0.1)):
        found = aj.local_stability(aj.Plant(panda), around, q, 1e-3).eigenvalues
        assert_allclose(found, expected)
    weak = aj.TorqueLimited(law, aj.Limits(effort=5.0))
    with pytest.raises(aj.InvalidInputError, match="with a torque within its limits, got"):
        aj.local_stability(aj.Plant(panda), weak, q, 1e-3)


class Weightless(OwnController):
    def evaluate(self, state, measurement, target):
        e = measurement.x - target
        J = self.task.jacobian(measurement.q)
        torque = -100.0 * J.T @ e - 5.0 * measurement.v
        return aj.Evaluation(torque, np.zeros(0), aj.Status.OK, e, J)


class Kinked(TaskSpacePD):
    def evaluate(self, state, measurement, target):
        answer = super().evaluate(state, measurement, target)
        return answer._replace(torque=answer.torque - 5.0 * np.maximum(measurement.v, 0.0))


class ByTheClock(TaskSpacePD):
    def evaluate(self, state, measurement, target):
        answer = super().evaluate(state, measurement, target)
        return answer._replace(torque=answer.torque * np.cos(measurement.t))


@pytest.mark.parametrize(
    ("kind", "dt", "text"),
    [
        (Weightless, None, "controller must hold the arm at rest at the target .* off by "),
        (Kinked, None, "controller must be smooth near the target"),
        (ByTheClock, 1e-3, "controller must be one whose step does not depend on the time"),
        (WindingUpNot, None, "dt must be given for a controller that runs in samples"),
        (lambda task: WindingUpNot(task, most=1e-3), 1e-3, "hold the arm .* best of its states"),
    ],
)
def test_what_cannot_be_linearised_says_why(kind, dt, text):
    plant, law = two_link_loop(kind)
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.local_stability(plant, law, GOAL, dt)


@pytest.mark.study
def test_a_run_decays_at_the_rate_that_is_told():
    plant, law = two_link_loop(WindingUpNot)
    local = aj.local_stability(plant, law, GOAL, 2e-3)
    x_d = plant.sensor.value(GOAL)
    run = aj.simulate(plant, law, x_d, GOAL + 0.01, 12.0, dt=2e-3, record_every=0.1)
    late = (run.t > 6.0) & (run.error_norm > 1e-12)
    rate = -np.polyfit(run.t[late], np.log(run.error_norm[late]), 1)[0]
    assert_allclose(rate, local.decay_rate, rtol=0.05)


def test_V_along_the_run_of_ones_own_law_falls_as_its_equation_says():
    """With J = Ĵ and exact gravity V̇ = −K_d|Jq̇|² − (B_c + B) q̇²."""
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    plant, law = aj.Plant(arm, task, friction=0.3), TaskSpacePD(task)
    run = aj.simulate(plant, law, task.value(GOAL), GOAL + 0.3, 1.0, dt=None, record_every=1e-3)
    M, e = plant.dynamics.M(run.q[300]), run.error[300]
    assert_allclose(run.V[300], 0.5 * run.v[300] @ M @ run.v[300] + 100.0 * e @ e)
    for k in (100, 400, 800):
        J, v = task.jacobian(run.q[k]), run.v[k]
        expected = -law.kd * (J @ v) @ (J @ v) - (law.damping + 0.3) * v @ v
        assert_allclose(run.V_dot[k], expected, rtol=1e-3)


def test_a_run_names_what_ones_own_law_learnt():
    plant, law = two_link_loop(WindingUpNot)
    run = aj.simulate(plant, law, plant.sensor.value(GOAL), GOAL, 0.1, dt=2e-3)
    assert dict(run.parameters) == {"force along x": "N", "force along z": "N"}
    assert_allclose(run.learnt, run.state)
    ax = aj.view.plot_parameters(run)
    assert [line.get_label() for line in ax.lines] == list(run.parameters)
    assert ax.get_ylabel() == "learnt [N]"
    wrong = WindingUpNot(law.task)
    wrong.parameters = {"force": "N"}
    with pytest.raises(aj.InvalidInputError, match="must name the 2 numbers that learnt"):
        aj.simulate(plant, wrong, plant.sensor.value(GOAL), GOAL, 0.1, dt=2e-3)


def test_ones_own_law_within_limits_keeps_them():
    plant, law = two_link_loop(TaskSpacePD)
    limited = aj.TorqueLimited(law, aj.Limits(effort=25.0), dt=2e-3)
    q0 = GOAL + np.array([0.5, -0.8])
    run = aj.simulate(plant, limited, plant.sensor.value(GOAL), q0, 6.0, dt=2e-3)
    assert np.abs(run.tau).max() <= 25.0 + 1e-9
    assert (run.limit_status == aj.LimitStatus.LIMITED).any()  # nothing is proven of it
    assert run.error_norm[-1] < 1e-3
    assert np.isfinite(run.V).all()


def study_of(kind, reach=0.1, **options):
    arm = aj.load_robot("two_link")
    errors = aj.Uncertainty(arm, object_length=(0.0, reach), object_axis="x")
    law = kind(errors.believed_task())
    region = aj.JointBox.around(arm, GOAL, 0.2)
    latency = aj.Latency(period=2e-3, torque_delay=2e-3)
    return aj.Study(law, errors, region, latency=latency, duration=4.0, **options)


def test_a_report_of_ones_own_law_says_which_tests_apply():
    study = study_of(TaskSpacePD, seed=1)
    report = study.report(40, runs=20)
    assert isinstance(report, aj.stability.OtherLawReport)
    none, near, runs = report.rows[3:]
    assert [row[1:3] for row in report.rows[3:]] == [
        ("certificates", "not applicable"), ("near targets", "stable"), ("rollouts", "pass"),
    ]  # fmt: skip
    assert "SetpointController" in none.figures["reason"]
    assert report.rows[1].text == "a period of 2 ms, torques 2 ms late"
    assert (near.figures["share"], near.figures["targets"]) == (1.0, 41)  # 40 drawn, one found
    assert (runs.figures["converged"], runs.figures["runs"]) == (20, 20)
    assert report.passed
    assert str(report).startswith("nothing is proven of this law; no test that applies speaks")
    assert report.summary()["decay_rates"] == report.local.decay_rates.tolist()
    # each is what `local_stability` says of that robot, late as the study says
    k = report.local.worst
    given = study.errors.plant(report.values[k])
    plant = aj.Plant(given.robot, given.sensor, actuator_delay=2e-3)
    alone = aj.local_stability(plant, study.controller, report.local.q[k], 2e-3)
    assert alone.decay_rate == report.local.decay_rates.min()
    assert alone.damping_ratio == report.local.damping_ratios[k]


def test_near_targets_an_image_is_late_by_half_the_time_between_them_too():
    def rates(**latency):
        found, _, refused = near_targets(setting, aj.Latency(period=2e-3, **latency), 2)
        assert not refused
        return found.decay_rates

    setting = study_of(TaskSpacePD, seed=1).setting()
    for age in (0.0, 0.01):
        as_age = rates(image_age=age + 0.02)
        assert_allclose(rates(image_age=age, image_period=0.04), as_age, rtol=1e-12)
        assert (np.abs(rates(image_age=age) - as_age) > 1e-3 * as_age).all()


def test_targets_that_only_some_robots_attain_are_told_of_the_robots_that_do():
    """Of tools that are long enough. No verdict is good that leaves the others out."""
    study = study_of(TaskSpacePD, reach=0.6, target=(2.2, 0.0), seed=2)
    report = study.report(20)
    near = report.rows[4]
    local, lengths = report.local, [report.setting.start(k).values[0] for k in range(20)]
    attains = [k for k, length in enumerate(lengths) if length >= 0.2]
    assert 0 < len(attains) < 20
    assert attains[0] > 0
    assert local.truth.tolist() == attains
    for k, q in zip(local.truth, local.q, strict=True):
        plant = report.setting.start(k).plant
        assert_allclose(plant.sensor.value(q), [2.2, 0.0], atol=1e-8)
    (left_out,) = near.figures["refused"].values()
    assert (left_out, near.figures["targets"]) == (20 - len(attains), len(attains))
    assert local.stable
    assert near.verdict == "not stable"
    assert not report.passed
    slowest = study.uncertainty.describe([lengths[attains[local.worst]]])
    assert near.figures["worst_truth"] == slowest
    assert near.figures["decay"] == local.decay_rates.min()


@pytest.mark.study
def test_targets_are_looked_at_with_each_lag_of_the_loop():
    """All of them at once: a period, torques that are late, a filter, and old x."""
    late = aj.Latency(4e-3, torque_delay=8e-3, velocity_filter=0.02, image_age=0.04)
    study = replace(study_of(TaskSpacePD), latency=late)
    local = study.report(20).local
    sensing = aj.Sensing(x_delay=0.04, velocity_filter=0.02)
    rates = []
    for k, q in zip(local.truth[:3], local.q, strict=False):
        given = study.setting().start(k).plant
        plant = aj.Plant(given.robot, given.sensor, sensing=sensing, actuator_delay=8e-3)
        rates.append(aj.local_stability(plant, study.controller, q, 4e-3).decay_rate)
    assert_allclose(local.decay_rates[:3], rates)


def test_a_report_finds_what_speaks_against_a_law():
    def shaky(task):
        return TaskSpacePD(task, kd=900.0)  # too much damping for the period

    report = study_of(shaky).report(20, runs=3)
    assert not report.passed
    assert [row.verdict for row in report.rows[4:]] == ["not stable", "fail"]
    weightless = study_of(Weightless).report(20)
    assert not weightless.passed
    assert [row.verdict for row in weightless.rows[4:]] == ["not applicable", "not run"]
    ((why, n),) = weightless.rows[4].figures["refused"].items()
    assert n == 1
    assert "hold the arm at rest at the target" in why


@pytest.mark.parametrize("kind", [TaskSpacePD, pytest.param(WindingUpNot, marks=pytest.mark.study)])
def test_tolerance_of_ones_own_law_is_by_rollouts_and_near_targets(kind):
    study = study_of(kind, reach=0.3)
    with pytest.raises(aj.InvalidInputError, match='tests must be "stable" or "rollouts", got'):
        study.tolerance()
    found = study.tolerance(["stable", "rollouts"], draws=4, precision=0.2, largest=2.0)
    assert found["rollouts"].scale > 0.5
    assert found["stable"].scale > 0.5


def test_tolerance_looks_at_as_many_targets_as_are_to_be_drawn(monkeypatch):
    of, counts = LocalTest.of, []

    def counted(found, q, truth):
        counts.append(len(q))
        return of(found, q, truth)

    monkeypatch.setattr(LocalTest, "of", counted)
    study_of(TaskSpacePD).tolerance(["stable"], draws=4, largest=1.0)
    assert counts == [4, 4]  # without errors, and with all of them


@pytest.mark.parametrize("largest", [0.3, 1.5, 3.0])
def test_what_never_fails_is_tolerated_up_to_the_most_that_is_tried(largest):
    found = study_of(TaskSpacePD).tolerance(["stable"], draws=3, largest=largest)["stable"]
    assert (found.scale, found.fails_at, found.worst_text) == (largest, np.inf, "")
    assert found.uncertainty.high == pytest.approx([0.1 * largest])


def test_a_held_law_within_limits_has_no_certificate_but_a_report():
    def held(task):
        law = aj.SetpointController(task, aj.Gains(60.0, 20.0, 1.0))
        return aj.HeldMeasurement(aj.TorqueLimited(law, dt=2e-3), 0.5)

    report = study_of(held).report(20)
    assert isinstance(report, aj.stability.OtherLawReport)
    assert report.rows[3].verdict == "not applicable"
    assert report.rows[4].verdict == "stable"


def test_where_no_test_applies_none_speaks_against_a_law():
    """The tracking law learns Ĵ, and its step depends on the time: it has rollouts alone."""
    report = study_of(functools.partial(aj.TrackingController, dt=2e-3)).report(20)
    assert [row.verdict for row in report.rows[3:]] == [*2 * ["not applicable"], "not run"]
    assert (report.passed, report.local.stable, report.local.share) == (False, False, 0.0)
    assert "speaks against" not in str(report)
    assert "of 0 configurations" in repr(report.local)


def test_what_a_controller_does_not_tell_has_a_default_or_a_named_error(panda):
    task = aj.PositionTask(panda)
    law, here = OwnController(task), aj.Plant(panda).measure(0.0, panda.neutral(), np.zeros(7))
    with pytest.raises(aj.InvalidInputError, match=r"must have an advance\(state, measurement"):
        aj.simulate(aj.Plant(panda), law, task.value(panda.neutral()), duration=0.01)
    for use in (
        lambda: law.with_task(task),
        lambda: law.kinematics_learnt(np.zeros(0)),
        lambda: law.learnt_robot(np.zeros(0)),
    ):
        with pytest.raises(aj.InvalidInputError, match="controller must "):
            use()
    np.testing.assert_array_equal(law.resumed(np.zeros(0), here), law.initial_state(here))
    assert str(law) == "own controller\n  position task (x, y, z) of panda"
    assert law.law is law
    assert not law.is_continuous
    assert law.learnt(np.zeros(3)).shape == (0,)


REDEFINED = """
class Own:
    c_bar = 0.5

    def s(self, e):
        return gamma * np.tanh(e / gamma)

    def S(self, e):
        return gamma**2 * np.log(np.cosh(e / gamma))

    def ds(self, e):
        return 1.0 - np.tanh(e / gamma) ** 2
"""


@pytest.mark.parametrize("how", ["simulate", "rollouts"])
def test_what_a_notebook_defines_anew_is_compiled_anew(how):
    """Of the same name, and with numbers of its module that have changed."""
    arm = aj.load_robot("two_link")
    errors = aj.Uncertainty(arm, PLANE, object_length=(0.0, 0.2))
    q, found = np.radians([40.0, 60.0]), {}
    module = sys.modules.setdefault("a_notebook", types.ModuleType("a_notebook"))
    for gamma in (0.05, 0.5):
        vars(module).update(gamma=gamma, np=np, __name__="a_notebook")
        exec(REDEFINED, vars(module))
        task = errors.believed_task()
        controller = aj.SetpointController(task, saturation=module.Own())
        for engine in ("python", "compiled" if how == "simulate" else "lanes"):
            if how == "simulate":
                computation = aj.simulation.Computation(engine=engine)
                plant, x_d = errors.plant([0.2]), np.array([0.5, 1.5])
                run = aj.simulate(plant, controller, x_d, q, 0.2, dt=1e-3, computation=computation)
                found[gamma, engine] = run.q[-1]
            else:
                region = aj.JointBox.around(arm, q, 0.2)
                study = aj.Study(controller, errors, region, duration=0.2)
                runs = study.rollouts(2, execution=aj.stability.Execution(engine=engine))
                found[gamma, engine] = runs.columns["final_error"]
    (slow, slow_code), (fast, fast_code) = ([*found.values()][k : k + 2] for k in (0, 2))
    assert np.abs(slow - fast).max() > 1e-3
    assert_allclose(slow_code, slow, rtol=1e-9)
    assert_allclose(fast_code, fast, rtol=1e-9)
