"""Late loops of arms with gravity: their linearisation against the simulated loop and runs."""

import functools

import numpy as np
import pinocchio as pin
import pytest
from tests.stability.periods import radii

import approxjac as aj
from approxjac.robots import GravityRegressor
from approxjac.stability.loop.linearization import linear_loop, stabilities

AROUND = {"panda": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], "ur5": [0.0, -1.2, 1.4, -1.0, -1.5, 0.0]}


class Late:
    """A loop that acts late on an arm with an unknown tool, its gravity known or learnt."""

    def __init__(self, name, seed, learns=False):
        rng = np.random.default_rng(seed)
        arm = aj.load_robot(name)
        belief, truth = arm.with_object(0.0), arm.with_object(rng.uniform(0.0, 0.2))
        self.q = np.array(AROUND[name]) + rng.uniform(-0.3, 0.3, arm.nv)
        period = rng.choice([2e-3, 4e-3, 1e-2])
        self.latency = aj.Latency(period=period, torque_delay=period * rng.integers(2, 5))
        kp = 10.0 ** rng.uniform(1.2, 2.0)
        gains = aj.Gains(kp, kp / rng.uniform(3.0, 15.0), rng.uniform(0.03, 0.3))
        gravity = None
        if learns:
            regressor = GravityRegressor(belief)
            theta, residual = regressor.fit(truth)
            assert residual < 1e-9
            gravity = aj.AdaptiveGravity(regressor, 0.02, 1.0, theta0=theta, torque_limits=np.inf)
        self.law = aj.SetpointController(aj.PositionTask(belief), gains, gravity=gravity)
        self.plant = aj.Plant(truth, aj.PositionTask(truth), friction=0.02)
        self.target = self.plant.sensor.value(self.q)
        self.steps = round(self.latency.torque_delay / period)

    def radius(self):
        """The spectral radius that is told."""
        parts = linear_loop(self.plant, self.law, self.q)
        timing = self.latency.in_samples()
        (found,) = stabilities(parts, 9.81, timing)
        return float(np.exp(timing.frame * found.max_real_eigenvalue))

    def after(self, z):
        """The state one period later: δq, q̇, what is learnt, and the torques that are under way."""
        n, model, robot = len(self.q), self.plant.robot.model, self.plant
        theta = len(z) - (2 + self.steps) * n
        q, v = pin.integrate(model, self.q, z[:n]), z[n : 2 * n]
        late = z[2 * n + theta :].reshape(self.steps, n)
        start = self.law.begin(robot.measure(0.0, self.q, 0.0 * v))
        state = start + z[2 * n : 2 * n + theta]
        answered = self.law.step(
            state, robot.measure(0.0, q, v), self.target, float(self.latency.period)
        )
        state_after, torque = answered[0] - start, answered[1].torque
        rest, (acting, *others) = (
            robot.dynamics.g(self.q),
            [*late, torque - robot.dynamics.g(self.q)],
        )
        substeps = 8
        h = self.latency.period / substeps
        for _ in range(substeps):  # Runge and Kutta's of fourth order
            a1 = robot.acceleration(q, v, acting + rest)
            q2, v2 = pin.integrate(model, q, 0.5 * h * v), v + 0.5 * h * a1
            a2 = robot.acceleration(q2, v2, acting + rest)
            q3, v3 = pin.integrate(model, q, 0.5 * h * v2), v + 0.5 * h * a2
            a3 = robot.acceleration(q3, v3, acting + rest)
            q4, v4 = pin.integrate(model, q, h * v3), v + h * a3
            a4 = robot.acceleration(q4, v4, acting + rest)
            q = pin.integrate(model, q, h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4))
            v = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        moved = pin.difference(model, self.q, q)
        return np.concatenate([moved, v, state_after, *others])

    def multipliers(self):
        """The eigenvalues of the simulated period, differentiated numerically."""
        n = len(self.q)
        state = self.law.begin(self.plant.measure(0.0, self.q, np.zeros(n)))
        units, h = np.eye((2 + self.steps) * n + len(state)), 1e-5
        A = np.array([(self.after(h * u) - self.after(-h * u)) / (2.0 * h) for u in units]).T
        return np.linalg.eigvals(A)

    def told(self, gravity=True):
        """The multipliers that are told: with held gravity, or as if it did not change."""
        timing, parts = self.latency.in_samples(), linear_loop(self.plant, self.law, self.q)
        parts = parts if gravity else parts._replace(G=0.0 * parts.G)
        (found,) = stabilities(parts, 9.81, timing)
        return np.exp(timing.frame * found.eigenvalues)

    def rate(self):
        """The rate at which the speed of a run near the target grows in its second half [1/s]."""
        plant = aj.Plant(
            self.plant.robot, self.plant.sensor, friction=self.plant.friction,
            actuator_delay=float(self.latency.torque_delay),
        )  # fmt: skip
        dt = float(self.latency.period)
        duration = dt * round(4.0 / abs(np.log(self.radius())))
        q0 = pin.integrate(plant.robot.model, self.q, 1e-7 * np.ones(len(self.q)))
        run = aj.simulate(plant, self.law, self.target, q0, duration, dt=dt, record_every=dt)
        speed = np.linalg.norm(run.v, axis=1)
        quarters = np.array_split(speed, 4)
        return 4.0 / duration * np.log(quarters[3].max() / quarters[2].max())


@functools.cache
def loops():
    return [Late(("panda", "ur5")[k % 2], k) for k in range(20)]


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("name", AROUND)
def test_the_multipliers_are_those_of_the_simulated_period(name, learns):
    """Self-motion, and what no joint feels of what is learnt, have 1 and are not told."""
    late = Late(name, 3 if name == "ur5" else 0, learns)
    own, told = late.multipliers(), late.told()
    lasting = told[np.abs(told) > 0.2]  # 0 is of delays, and many times one
    assert len(lasting) >= 2 * len(late.q) - (len(late.q) - 3)
    nearest = np.abs(lasting[:, np.newaxis] - own).min(axis=1)
    assert nearest.max() < 1e-7
    moving = np.abs(own)[np.abs(own - 1.0) > 1e-7]
    assert late.radius() == pytest.approx(moving.max(), abs=2e-8)
    without = late.told(gravity=False)
    assert np.abs(without[:, np.newaxis] - own).min(axis=1).max() > 1e-5


@pytest.mark.study
def test_of_late_loops_some_are_unstable_by_the_gravity_that_they_hold():
    """As if it did not change they would be told to be stable, and their runs grow."""
    unstable = {k for k, late in enumerate(loops()) if late.radius() >= 1.0}
    wrongly = {k for k in unstable if np.abs(loops()[k].told(gravity=False)).max() < 1.0}
    assert (len(unstable), len(wrongly)) == (6, 5)
    for k in wrongly:
        told = np.log(loops()[k].radius()) / loops()[k].latency.period
        assert loops()[k].rate() == pytest.approx(told, rel=0.2), k
    assert all(loops()[k].rate() < 0.0 for k in (7, 11))


@pytest.mark.study
def test_a_report_of_such_a_loop_does_not_certify_it():
    """It would have: the certificate asks for more than is true, but not of this."""
    late = loops()[4]
    assert late.radius() > 1.01
    region = aj.JointBox.around(late.plant.robot, late.q, 0.01)
    report = aj.Study(late.law, late.plant, region, latency=late.latency).report(20)
    assert (radii(report.loop, report.samples, late.latency) > 1.01).all()
    assert report.growth.rate > np.log(1.01) / late.latency.period
    assert report.refuted
    assert not report.passed
    assert report.reason == "unstable"
