"""Damping that is raised until a joint swings."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from tests.controllers.test_motor_damping import largest_stable

import approxjac as aj
from approxjac import law
from approxjac.controllers.gains.motors import crossover, largest_rate

LATE = aj.Latency(1e-3, torque_delay=1e-3, velocity_filter=5e-3)
OMEGA, DT = crossover(LATE), LATE.period


def raised(n, quiet=np.inf, dt=DT):
    """That of n joints alike, whose damping may grow twentyfold."""
    ones = np.ones(n)
    return law.RaisedDamping.of(OMEGA, 3e-3 * ones, (ones, 19.0 * ones), quiet * ones, dt)


def after(watch, speeds):
    """Shares and their paces after q̇ (steps, n)."""
    memory, n = watch.start(speeds[0]), speeds.shape[1]
    for v in speeds:
        memory, _ = watch.step(memory, v)
    return memory[:n], memory[n : 2 * n]


def test_the_lag_is_a_right_angle_at_the_crossover():
    delay = LATE.torque_delay + LATE.period  # half of it as q̇ is of differences
    assert_allclose(OMEGA * delay + np.arctan(5e-3 * OMEGA), 0.5 * np.pi)


@pytest.mark.parametrize("dt", [5e-4, DT, 4e-3])
def test_damping_grows_by_e_in_half_a_second_and_has_its_rate(dt):
    watch = raised(1, dt=dt)
    memory, n = watch.start(np.zeros(1)), 0
    while memory[0] < 1.0:
        before = memory[0]
        memory, rate = watch.step(memory, np.zeros(1))
        assert_allclose(memory[0] - before, dt * rate[0], atol=1e-12)
        n += 1
    assert n * dt == pytest.approx(0.5 * np.log(20.0), rel=0.02)
    assert watch.step(memory, np.zeros(1))[0][0] == 1.0


@pytest.mark.parametrize("times", [1.0, 1.5, 3.0])
def test_a_swing_that_grows_halves_it_and_makes_it_slower(times):
    watch, t = raised(2), DT * np.arange(2000)
    swing = 1e-3 * np.exp(5.0 * np.maximum(t - 1.0, 0.0)) * np.sin(times * OMEGA * t)
    memory, halved = watch.start(np.zeros(2)), []
    for i, v in enumerate(swing):
        before = memory[:2]
        memory, _ = watch.step(memory, np.array([v, 0.0]))
        if memory[0] < before[0]:
            left = 0.5 * (before[0] + 1 / 19) - 1 / 19
            assert_allclose(memory[0], max(left, 0.0), atol=1e-9)
            halved.append(i)
    assert 1100 < halved[0] < 1600
    assert_allclose(memory[2], max(2.0 * 0.25 ** len(halved), 0.02))
    assert memory[1] == 1.0  # of the joint that stands


def test_a_swing_near_the_damping_at_first_does_not_slow_what_follows():
    """Such as that of gears which the first frames of x excite, and which dies away."""
    watch, t = raised(2), DT * np.arange(1500)
    swing = 0.05 * np.exp(-20.0 * np.maximum(t - 0.1, 0.0)) * np.sin(1.5 * OMEGA * t)
    memory = watch.start(np.zeros(2))
    lowered = 0
    for v in swing:
        before = memory[0]
        memory, _ = watch.step(memory, np.array([v, 0.0]))
        lowered += memory[0] < before
    assert lowered >= 1
    assert (memory[2:4] == 2.0).all()
    assert memory[0] > 0.3  # a second later


@pytest.mark.parametrize("times", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("growth", [20.0, 40.0])
def test_a_swing_that_dies_once_it_is_halved_is_halved_once(times, growth):
    watch, memory, size, lowered = (each := raised(1)), each.start(np.zeros(1)), 1e-4, 0
    for now in DT * np.arange(2500):
        before = memory[0]
        size *= np.exp(DT * (0.0 if now < 0.8 else -growth if lowered else growth))
        memory, _ = watch.step(memory, np.array([size * np.sin(times * OMEGA * now)]))
        lowered += memory[0] < before
    assert lowered == 1


def test_neither_motion_nor_what_dies_away_nor_noise_lowers_it(rng):
    t = DT * np.arange(5000)[:, None]
    motion = np.sin(2.0 * np.pi * rng.uniform(0.2, 3.0, 20) * t + rng.uniform(0.0, 6.0, 20))
    since = np.mod(t, 0.5)  # it is hit twice a second
    ringing = 0.1 * np.exp(-0.15 * OMEGA * since) * np.sin(OMEGA * since + np.zeros(5))
    noise = rng.normal(size=(5000, 20)) * np.geomspace(1e-3, 0.01, 20)
    assert (after(raised(20), motion)[1] == 2.0).all()
    for hit in (ringing, motion[:, :5] + ringing):
        assert (after(raised(5), hit)[1] >= 0.5).all()  # once at most, by ten hits
    assert np.mean(after(raised(20), noise)[1] == 2.0) >= 0.9


def test_noise_that_motors_would_feel_keeps_it_low(rng):
    noise = rng.normal(size=(8000, 3)) * np.array([1e-4, 0.01, 0.3])
    share, _ = after(raised(3, quiet=0.1), noise)
    assert share[0] == 1.0
    assert (1.0 + 19.0 * share[1]) * 0.01 < 3.0 * 0.1
    assert share[2] == 0.0


@pytest.mark.parametrize("dt", [4e-3, 8e-3])
def test_noise_is_forgotten_by_e_in_a_second_whatever_the_period(dt, rng):
    """Motors that stand a tenth of it are damped more ln 10 s later."""
    one, omega = np.ones(1), crossover(aj.Latency(dt, torque_delay=1e-3))
    noise, waited = 0.3 * rng.normal(size=(round(5.0 / dt), 1)), []
    for quiet in (0.1, 0.01):
        watch = law.RaisedDamping.of(omega, 3e-3 * one, (one, 19.0 * one), quiet * one, dt)
        memory, n = watch.start(np.zeros(1)), 0
        for v in noise:
            memory, _ = watch.step(memory, v)
        assert memory[0] == 0.0
        while memory[0] == 0.0:
            memory, _ = watch.step(memory, np.zeros(1))
            n += 1
        waited.append(n * dt)
    assert waited[1] - waited[0] == pytest.approx(np.log(10.0), rel=0.1)


@pytest.mark.parametrize("bits", [14, 17, 20])
def test_an_encoder_that_counts_does_not_lower_it(bits):
    """Its steps are a tone of any frequency, with q' by a filter of 5 ms: slow and fast motions."""
    count, t = 2.0 * np.pi / 2**bits, DT * np.arange(6000)[:, None]
    speeds = count * np.geomspace(10.0, 300.0, 20)
    q = np.floor((speeds * t + 0.02 * np.sin(np.linspace(1.0, 9.0, 20) * t)) / count) * count
    v, filtered = np.zeros(20), []
    for moved in np.diff(q, axis=0):
        v = v + DT / (5e-3 + DT) * (moved / DT - v)
        filtered.append(v)
    ones = np.ones(20)
    watch = law.RaisedDamping.of(
        OMEGA, 3e-3 * ones, (ones, 19.0 * ones), np.inf * ones, DT, filtered=5e-3
    )
    assert np.mean(after(watch, np.array(filtered))[1] == 2.0) >= 0.9


@pytest.mark.parametrize("dt", [5e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("filtered", [0.0, 1e-3, 2e-3, 5e-3, 15e-3])
def test_an_encoder_that_goes_to_and_fro_does_not_lower_it(dt, filtered):
    """Between two counts, half swings at ω₉₀ apart or more: of a joint that stands at an edge."""
    count, n = 2.0 * np.pi / 2**13, 40
    omega = crossover(aj.Latency(dt, torque_delay=1e-3, velocity_filter=filtered))
    rhythms = int(np.ceil(1.1 * np.pi / (omega * dt))) + np.arange(n)
    q = count * (np.arange(1500)[:, None] // rhythms % 2)
    v, filtering = np.zeros(n), []
    for moved in np.diff(q, axis=0):
        v = v + dt / (filtered + dt) * (moved / dt - v)
        filtering.append(v)
    ones, most = np.ones(n), np.inf * np.ones(n)
    watch = law.RaisedDamping.of(
        omega, 3e-3 * ones, (ones, 19.0 * ones), most, dt, filtered=filtered
    )
    assert (after(watch, np.array(filtering))[1] == 2.0).all()


def test_no_elastic_joint_swings_far_and_each_gets_much_of_what_it_stands(rng):
    """Random links, springs and rotors, with encoders of 20 bits: 60 loops of 8 s."""
    n = 60
    J, M, K = 10.0 ** rng.uniform((-1.5, -1.0, 3.0), (0.0, 1.0, 5.0), (n, 3)).T
    least = 0.5 * largest_rate(LATE) * J * 10.0 ** rng.uniform(-1.0, 0.0, n)
    stable = np.array([
        largest_stable(*joint, 0.05, 2e-3, 5e-3, 0.0) for joint in zip(J, M, K, strict=True)
    ])  # fmt: skip
    more = 3.0 * stable
    watch = law.RaisedDamping.of(
        OMEGA, np.full(n, 3e-3), (least, more), np.full(n, np.inf), DT, filtered=5e-3
    )
    D = 0.1 * np.sqrt(K * J * M / (J + M))
    flows = np.array([flow(*each) for each in zip(J, M, K, D, strict=True)])
    state, late, fastest = np.zeros((n, 4)), np.zeros((2, n)), 0.0  # q, q̇, θ, θ̇; torques
    state[:, 3] = 0.02 * rng.normal(size=n)
    seen, v, memory = state[:, 2].copy(), np.zeros(n), watch.start(np.zeros(n))
    for i in range(8000):
        theta = np.round(state[:, 2] / 6e-6) * 6e-6
        v = v + DT / (5e-3 + DT) * ((theta - seen) / DT - v)
        seen, share = theta, memory[:n]
        memory, _ = watch.step(memory, v)
        late = np.stack([late[1], -(least + share * more) * v])
        inputs = np.concatenate([state, late[:1].T], axis=1)
        state = np.einsum("nij,nj->ni", flows, inputs)
        if i > 500:
            fastest = np.maximum(fastest, np.abs(state[:, 3]))
    got = (least + memory[:n] * more) / stable
    assert np.quantile(fastest, 0.8) < 0.1
    assert fastest.max() < 0.5
    assert np.median(got) > 0.5


def flow(J, M, K, D):
    """The four rows of exp of one period, with a torque at the motor."""
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = 1.0
    spring = np.array([K, D, -K, -D, 0.0])
    A[1], A[3] = -spring / M, spring / J
    A[3, 4] = 1.0 / J
    return expm(DT * A)[:4]


def test_the_smallest_value_brings_its_rate(rng):
    """Of numbers, and entry by entry of what is traced."""
    for _ in range(20):
        values, rates = rng.normal(size=(2, 6))
        i = values.argmin()
        assert law.smallest(values, rates) == (values[i], rates[i])
        assert law.smallest(values.astype(object), rates.astype(object)) == (values[i], rates[i])


def test_the_reference_and_its_derivative_agree_while_gains_rise(monkeypatch):
    arm = aj.load_robot("panda")
    task, plant = aj.PositionTask(arm), aj.Plant(arm)
    known = aj.controllers.KnownKinematics(task)
    controller = aj.TrackingController(task, kinematics=known, latency=LATE)
    q0, seen, usual = plant.ready_configuration(), [], controller._reference

    def noted(*given):
        answer = usual(*given)
        seen.append((answer[1], answer[2], given[5].alpha, given[5].alpha_dot))
        return answer

    monkeypatch.setattr(controller, "_reference", noted)
    goal, state = task.value(q0) + [0.05, 0.1, -0.05], None
    for t in DT * np.arange(400):
        q, v = q0 + 0.05 * np.sin(2.0 * t), np.full(7, 0.1 * np.cos(2.0 * t))
        measurement = aj.Measurement(float(t), q, v, task.value(q), float(t))
        state = controller.initial_state(measurement) if state is None else state
        state, _ = controller.step(state, measurement, goal, DT)
    v_r, a_r, alpha, alpha_dot = (np.array(each) for each in zip(*seen, strict=True))
    assert (alpha_dot[100:] > 0.1).all()
    slope = (v_r[2:] - v_r[:-2]) / (2.0 * DT)
    assert_allclose(a_r[1:-1][100:], slope[100:], rtol=0.01, atol=0.01 * np.abs(slope).max())
    said = controller.describe_learnt(state)
    assert float(said.removesuffix(" 1/s").split()[-1]) == pytest.approx(alpha[-1], rel=0.01)
