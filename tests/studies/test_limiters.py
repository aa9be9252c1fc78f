"""The study of limiters: what is measured of a run, and a verdict that can be bad."""

import limiters
import numpy as np
import pytest
from limiters import Case
from lyapunov_decrease import excess
from usual_limiters import TaskTorqueScaled

import approxjac as aj

pytestmark = pytest.mark.study
CASE = Case("two_link", 0.35, 0, 1.0)  # motors too weak for what the law asks


@pytest.fixture(scope="module")
def built():
    return limiters.prepare(CASE)


@pytest.fixture(scope="module")
def outcomes():
    return {outcome.limiter: outcome for outcome in limiters.run_case(CASE)}


class Changed(aj.Controller):
    """A limiter whose answers are changed."""

    def __init__(self, controller, change):
        self.controller, self.change, self.task = controller, change, controller.task

    def begin(self, measurement):
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        state, answer = self.controller.advance(state, measurement, target, dt)
        return state, self.change(answer)


def changed(built, change):
    controller = Changed(limiters.limiter("clip", built), change)
    return limiters.run_limiter(CASE, "qp", built, controller)


def test_a_start_can_be_held_with_the_scaled_limits(built):
    limits = built.limits
    assert np.array_equal(built.plant.torque_limits, limits.effort)
    assert (np.abs(built.plant.dynamics.g(built.q0)) <= 0.7 * np.asarray(limits.effort)).all()
    full = limiters.full_limits(built.plant.robot)  # of which the URDF knows none
    assert limits.effort == pytest.approx(0.35 * np.asarray(full.effort))
    heaviest = np.abs(built.plant.dynamics.g(np.zeros(2)))  # stretched out along the horizontal
    assert full.effort == pytest.approx(2.0 * heaviest, rel=0.01)
    panda = aj.load_robot("panda")
    assert np.array_equal(limiters.full_limits(panda).effort, panda.effort_limits)


def test_every_limiter_runs_the_same_reach_and_keeps_the_limits(outcomes):
    assert list(outcomes) == list(limiters.LIMITERS)
    assert len({outcome.start_error for outcome in outcomes.values()}) == 1
    for outcome in outcomes.values():
        assert sum(outcome.statuses.values()) == 1001  # each step once, the first one too
        assert outcome.torque_violation <= 1e-9
        assert outcome.peak_torque == pytest.approx(1.0)
        assert outcome.proof.breaches == 0
        assert outcome.proof.instants + outcome.proof.singular > 90
    assert outcomes["clip"].proof.largest_excess > 100.0
    assert outcomes["clip"].peak_speed > 1.5 > outcomes["qp"].peak_speed
    assert outcomes["qp"].statuses["PROOF_GIVEN_UP"] > 0
    assert limiters.shortcomings(list(outcomes.values())) == []
    assert "| two_link | × 0.35 | 1 |" in limiters.table(list(outcomes.values()))
    assert "| × 0.35 | qp | " in limiters.arms(list(outcomes.values()))


def test_finite_differences_of_V_agree_with_the_identity(built):
    rng = np.random.default_rng(0)
    plant, law, alpha = aj.Plant(built.plant.robot, built.plant.sensor), built.law, 0.7
    for _ in range(20):
        q, v = rng.uniform(0.4, 2.0, 2), rng.normal(size=2)
        tau = rng.normal(size=2) * 50.0
        value, error = excess(plant, law, alpha, q, v, tau, built.target)
        measurement = aj.Measurement(0.0, q, v, plant.sensor.value(q))
        answer = law.evaluate(np.zeros(0), measurement, built.target)
        y = law.passive_output(answer, v, alpha)
        assert value == pytest.approx(y @ (tau - answer.torque), abs=error)
        assert error < 1e-6 * max(1.0, abs(value))


def test_a_limiter_that_lies_about_its_slack_is_caught(built, outcomes):
    status = aj.LimitStatus.PROOF_KEPT
    liar = changed(built, lambda answer: answer._replace(limit_status=status, slack=0.0))
    assert liar.proof.breaches > 10
    assert liar.proof.largest_breach > 100.0
    (short,) = limiters.shortcomings([liar, outcomes["clip"]])
    assert "V̇ was above −W by more than the slack that was reported" in short


def test_a_limiter_that_breaks_a_limit_is_caught(built, outcomes):
    strong = changed(built, lambda answer: answer._replace(torque=1.001 * answer.torque))
    assert strong.torque_violation > 1e-3
    assert any("beyond a torque limit" in s for s in limiters.shortcomings([strong]))


def test_failures_are_named_and_fewer_runs_than_with_clipping_are_a_shortcoming(outcomes):
    proof = outcomes["qp"].proof
    done = limiters.Outcome(CASE, "clip", 0.5, 1e-5, 2.0, True, True, proof=proof)
    failed = done._replace(limiter="qp", converged=False, within=False, reason="a dead end: joint2")
    beyond = done._replace(within=False, position_excess=2.0)
    (short,) = limiters.shortcomings([done, failed])
    assert short.startswith("at 0.35 of the limits fewer runs converged within the joints' limits")
    text = "\n".join(limiters.failures([failed, beyond]))
    assert "- qp, 1 × a dead end (1 at 0.35); such as two_link, seed 0: 500 -> 0.01 mm" in text
    assert "- clip, 1 × done, but with a joint more than 0.01 rad beyond" in text


def test_scaling_keeps_the_direction_of_the_task_torque():
    panda, rng = aj.load_robot("panda"), np.random.default_rng(0)
    task = aj.PositionTask(panda)
    law = aj.SetpointController(task, aj.default_gains(task))
    effort = 0.9 * panda.effort_limits
    scaled = TaskTorqueScaled(law, aj.Limits(effort))
    q = panda.random_configuration(rng)
    x = law.task.value(q)
    measurement, target = aj.Measurement(0.0, q, np.zeros(7), x), x + [2.0, -1.0, 1.0]
    g = law.gravity_torque(np.zeros(0), q)
    wanted = law.evaluate(np.zeros(0), measurement, target).torque - g
    _, answer = scaled.step(np.zeros(0), measurement, target, 1e-3)
    got = answer.torque - g
    share = got @ wanted / (wanted @ wanted)
    assert 0.0 < share < 1.0
    np.testing.assert_allclose(got, share * wanted, atol=1e-9)
    assert np.abs(answer.torque / effort).max() == pytest.approx(1.0)
    # where gravity is too much it is clipped
    _, answer = TaskTorqueScaled(law, aj.Limits(1.0)).step(np.zeros(0), measurement, target, 1e-3)
    np.testing.assert_allclose(answer.torque, np.clip(g, -1.0, 1.0), atol=1e-12)
