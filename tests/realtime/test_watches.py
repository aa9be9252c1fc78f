"""Measurements held against each other: what is sound raises no alarm, what is broken does."""

import math

import faults as study
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import approxjac as aj
from approxjac.realtime import Accuracy, Fault, SimulatedDriver
from approxjac.realtime.watches import FaultWatch, SensorWatch
from approxjac.tasks.frame_tasks import FrameKinematics

DT = 1e-3
PANDA = aj.load_robot("panda")
TRUTH = PANDA.with_object(0.2, 0.5, axis="x")
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
UR5 = np.array([0.2, -1.2, 1.4, -1.0, -1.0, 0.3])
SLOW = (*study.MOTORS, *study.EVENTS)
# in the same way as others: a joint's as all joints', NaN as infinite, one jump as another; three
# in mid motion or from the start; of the last five is looked at below that they are found
AS_OTHERS = (
    "encoder frozen, q̇ held", "q̇ of a joint 0", "q drifts", "q̇ in degrees", "q̇ halved", "q NaN",
    "q̇ NaN", "x frozen, with noise", "x in millimetres", "x mirrored from the start", "clock jumps",
    "send raises", "q̇ held", "encoder frozen, q̇ fades", "x turned by 90°", "q counts backwards",
    "q̇ spike", "q̇ with the wrong sign", "x jumps", "q infinite",
)  # fmt: skip


def motion(t, size=0.3, rate=2.0):
    """A smooth motion of all joints: q and q̇."""
    phases = np.arange(7)
    return (
        START + size * (np.sin(rate * t + phases) - np.sin(phases)),
        size * rate * np.cos(rate * t + phases),
    )


def watched(change=None, seconds=0.6, noise=0.0, dt=DT, accuracy=None, sent=None, side=1.0):
    """The first fault that a watch finds in the motion, as `change` alters it, and when.

    With a `side` of −1 all joints move, and are pushed, the other way.
    """
    accuracy = accuracy or Accuracy(q=1e-5, v=1e-3)
    watch = FaultWatch(PANDA, dt, accuracy, PANDA.velocity_limits, 0.02, False)
    rng = np.random.default_rng(0)
    for k in range(round(seconds / dt)):
        t = k * dt
        q, v = motion(t)
        q = q + noise * 1e-5 * rng.standard_normal(7)
        v = v + noise * 1e-3 * rng.standard_normal(7)
        m = aj.Measurement(t, q, v, np.zeros(3))
        m = m if change is None else change(m)
        m = m._replace(q=START + side * (m.q - START), v=side * m.v)
        fault = watch.look(m, 10.0 + t)
        if fault is not None:
            return fault, t
        watch.commanded(side * (np.zeros(7) if sent is None else sent(t)), None)
    return None, seconds


def from_then(broken, at=0.2):
    """Change a measurement from an instant on; `broken` gets the last sound one, too."""
    kept = []

    def change(m):
        if m.t < at:
            kept[:] = [m]
            return m
        return broken(m, kept[0])

    return change


def entry(array, k, value):
    changed = array.copy()
    changed[k] = value
    return changed


BROKEN = {
    "dead encoder": (
        lambda m, old: m._replace(q=entry(m.q, 3, old.q[3]), v=entry(m.v, 3, 0.0)),
        {Fault.VELOCITY_JUMPED, Fault.ENCODER_FROZEN},
    ),
    "dead encoder, live tachometer": (
        lambda m, old: m._replace(q=entry(m.q, 3, old.q[3])), {Fault.VELOCITY_DISAGREES},
    ),
    "dead tachometer": (
        lambda m, old: m._replace(v=entry(m.v, 0, 0.0)),
        {Fault.VELOCITY_JUMPED, Fault.VELOCITY_DISAGREES},
    ),
    "jump": (lambda m, old: m._replace(q=entry(m.q, 2, m.q[2] + 0.02)), {Fault.POSITION_JUMPED}),
    "sign": (
        lambda m, old: m._replace(v=-m.v), {Fault.VELOCITY_JUMPED, Fault.VELOCITY_DISAGREES},
    ),
    "degrees": (
        lambda m, old: m._replace(v=np.degrees(m.v)),
        {Fault.VELOCITY_JUMPED, Fault.VELOCITY_DISAGREES},
    ),
    "NaN": (lambda m, old: m._replace(q=entry(m.q, 5, math.nan)), {Fault.JOINTS_UNKNOWN}),
    "old state": (lambda m, old: old, {Fault.CLOCK_STOOD_STILL}),
    "clock jumps": (lambda m, old: m._replace(t=m.t + 0.5), {Fault.CLOCK_JUMPED}),
    "clock is set forward": (lambda m, old: m._replace(t=m.t + 0.015), {Fault.CLOCK_JUMPED}),
    "clock is set back": (lambda m, old: m._replace(t=m.t - 0.015), {Fault.CLOCK_JUMPED}),
    "clock goes back": (lambda m, old: m._replace(t=m.t - 0.1), {Fault.CLOCK_JUMPED}),
    "too fast": (
        lambda m, old: m._replace(
            q=old.q + 3.0 * (m.t - old.t) ** 2 * np.ones(7) * 3.0,
            v=18.0 * (m.t - old.t) * np.ones(7),
        ),
        {Fault.TOO_FAST, Fault.VELOCITY_DISAGREES, Fault.VELOCITY_JUMPED},
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken_is_found_within_20_ms(what):
    """Just as soon where all joints move the other way."""
    broken, faults = BROKEN[what]
    fault, t = watched(from_then(broken))
    assert fault in faults
    assert 0.2 <= t <= (0.4 if what == "too fast" else 0.22)
    assert watched(from_then(broken), side=-1.0) == (fault, t)


def test_an_arm_that_runs_faster_than_its_clock_is_found():
    fault, t = watched(lambda m: m._replace(t=m.t / 1.33))
    assert fault is Fault.VELOCITY_DISAGREES
    assert t < 0.1


def test_a_joint_that_does_not_answer_its_torque_is_found():
    def stands(m):
        return m._replace(q=entry(m.q, 1, START[1]), v=entry(m.v, 1, 0.0))

    assert watched(stands)[0] is None  # it may stand still
    pushed = PANDA.effort_limits * (np.arange(7) == 1)
    for side in (1.0, -1.0):
        fault, t = watched(stands, sent=lambda t: min(t, 0.2) * pushed, side=side)
        assert fault is Fault.COMMAND_UNANSWERED
        # 12 % of its largest torque and of what it is asked for; then it would move, with its rotor
        assert 0.13 < t < 0.165, t


def test_speed_that_grows_and_grows_is_found():
    """Just as soon in the other direction."""

    def grows(m):
        return m._replace(
            q=START + 1e-3 * (math.exp(m.t / 0.06) - 1.0) * np.ones(7),
            v=1e-3 / 0.06 * math.exp(m.t / 0.06) * np.ones(7),
        )

    fault, t = watched(grows)
    assert fault in (Fault.SPEED_GREW, Fault.VELOCITY_JUMPED)
    assert watched(grows, side=-1.0) == (fault, t)
    assert 1e-3 / 0.06 * math.exp(t / 0.06) < 0.6 * PANDA.velocity_limits.max()


@pytest.mark.parametrize("dt", [4e-3, 8e-3])
@pytest.mark.parametrize(("times", "fault"), [(4, None), (5, Fault.SPEED_GREW)])
def test_speed_that_grows_five_times_is_found_at_any_period(dt, times, fault):
    """By half in 32 ms each, which a whole number of periods is."""
    window = 0.032
    watch, q, found = FaultWatch(PANDA, dt, ACCURATE, PANDA.velocity_limits, 0.02, False), START, []
    before = 0.0 * START
    for k in range(round((12 + times) * window / dt)):
        grows = np.clip(k * dt / window - 8.0, 0.0, times)
        v = 0.05 * PANDA.velocity_limits * 1.5**grows * np.array([1, -1, 1, -1, 1, -1, 1])
        v = v * min(k / 4.0, 1.0)
        q, before = q + 0.5 * dt * (v + before), v
        found.append(watch.look(aj.Measurement(k * dt, q, v, np.zeros(3)), 10.0 + k * dt))
        watch.commanded(np.zeros(7), None)
    assert set(found) == {None, fault}
    if fault is not None:
        assert dt * found.index(fault) == pytest.approx(13.0 * window, abs=dt)


@given(
    size=st.floats(0.0, 0.5), rate=st.floats(0.1, 3.0), noise=st.floats(0.0, 1.0),
    missed=st.integers(0, 3), quantum=st.sampled_from([0.0, 1e-5]),
)  # fmt: skip
@pytest.mark.study
def test_sound_measurements_raise_no_alarm(size, rate, noise, missed, quantum):
    def sound(m):
        if 0.1 < m.t < 0.1 + missed * DT:
            return m._replace(q=np.full(7, math.nan))
        q, v = motion(m.t, size, rate)
        q = q + (m.q - motion(m.t)[0])
        v = v + (m.v - motion(m.t)[1])
        return m._replace(q=quantum * np.rint(q / quantum) if quantum else q, v=v)

    assert watched(sound, 0.3, noise) == (None, 0.3)


MOVING = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # joints that carry the tip along


def looked(change, seconds=0.6, rate=60.0, age=0.03, noise=3e-4, **options):
    """The first fault that the watch over x finds while the joints move, and when."""
    task, sensor = aj.PositionTask(PANDA.with_object(0.0)), aj.PositionTask(TRUTH)
    tool = options.get("tool", 0.25)
    accuracy = Accuracy(q=1e-5, v=1e-3, x=noise, x_period=1.0 / rate, tool=tool)
    watch = SensorWatch(task, DT, accuracy, np.full(3, 0.01), options.get("is_learnt", False))
    rng, x, t_x, taken = np.random.default_rng(0), np.full(3, math.nan), 0.0, []
    for k in range(round(seconds / DT)):
        t = k * DT
        q, v = (START + MOVING * (motion(t)[0] - START), MOVING * motion(t)[1])
        if k % round(1.0 / rate / DT) == 0:
            seen = sensor.value(q) + noise * rng.standard_normal(3)
            taken.append((t, change(t, seen)))
        if taken and t - taken[0][0] >= age:
            t_x, x = taken.pop(0)
        fault = watch.look(aj.Measurement(t, q, v, x, t_x), sensor.value(q))
        if fault is not None:
            return fault, t
    return None, seconds


TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
WRONG = {
    "metres for millimetres": (lambda t, x: 1e3 * x, {Fault.SENSOR_JUMPED}, 0.1),
    "turned": (lambda t, x: TURN @ x, {Fault.SENSOR_JUMPED, Fault.SENSOR_DISAGREES}, 0.1),
    "mirrored": (
        lambda t, x: x * [1.0, -1.0, 1.0], {Fault.SENSOR_JUMPED, Fault.SENSOR_DISAGREES}, 0.2,
    ),
    "jump": (
        lambda t, x: x + 0.1 * (t > 0.2), {Fault.SENSOR_JUMPED}, 0.26,
    ),
    "lost": (lambda t, x: x if t < 0.2 else np.full(3, math.nan), {Fault.BLIND}, 0.27),
    "frozen": (
        lambda t, x: x if t < 0.2 else np.array([0.5, 0.0, 0.5]),
        {Fault.SENSOR_JUMPED, Fault.SENSOR_FROZEN}, 0.3,
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_an_x_that_is_wrong_is_found(what):
    change, faults, latest = WRONG[what]
    fault, t = looked(change)
    assert fault in faults
    assert t <= latest


@pytest.mark.parametrize(
    ("rate", "age", "noise"),
    [pytest.param(1000.0, 0.0, 3e-4, marks=pytest.mark.study), (60.0, 0.03, 2e-3)],
)
def test_a_tool_that_nobody_told_of_raises_no_alarm(rate, age, noise):
    assert looked(lambda t, x: x, 2.0, rate, age, noise) == (None, 2.0)


TRACKER = np.array([0.4, -0.8, 2.0])  # rotation vector of one that is believed


@pytest.mark.parametrize(
    "kind",
    [
        "position",
        "tracker",
        *(pytest.param(kind, marks=pytest.mark.study) for kind in ("plane", "pose", "elbow")),
    ],
)
@given(tool=st.tuples(*[st.floats(-0.14, 0.14)] * 3), seed=st.integers(0, 99))
@settings(max_examples=8)
def test_no_tool_within_its_bound_raises_an_alarm_whatever_else_is_known(kind, tool, seed):
    """Without noise and with an exact Ĵ nothing is left that hides a bound that is too tight."""
    made = {
        "position": aj.PositionTask, "plane": lambda arm: aj.PositionTask(arm, axes="xz"),
        "pose": aj.PoseTask, "tracker": lambda arm: aj.tasks.TrackerTask(arm, TRACKER),
        "elbow": lambda arm: aj.PositionTask(arm, "panda_link5"),
    }  # fmt: skip
    belief = made[kind](PANDA)
    link = FrameKinematics(PANDA, "panda_link5" if kind == "elbow" else PANDA.tip)
    axes = pin.exp3(TRACKER) if kind == "tracker" else np.eye(3)
    accuracy = Accuracy(x=1e-9, x_period=0.02, tool=0.25, jacobian=1e-9)
    watch = SensorWatch(belief, DT, accuracy, np.full(belief.m, 0.01), False)
    rates = 3.0 * np.random.default_rng(seed).random(7)
    for k in range(300):
        q, v = START + 0.4 * np.sin(rates * k * DT), 0.4 * rates * np.cos(rates * k * DT)
        x = belief.value(q)
        away = axes @ link.placement(q)[0] @ tool
        x[: min(3, belief.m)] += away[[0, 2]] if kind == "plane" else away
        assert watch.look(aj.Measurement(k * DT, q, v, x, k * DT), x) is None


@pytest.mark.parametrize(("share", "found"), [(0.98, False), (1.05, True)])
def test_a_tool_that_turns_across_its_axis_may_be_as_far_off_as_is_told(share, found):
    """Then it moves by 2 sin(φ/2) times its length, and nothing is left of its bound."""
    task = aj.PositionTask(PANDA)
    link = FrameKinematics(PANDA, PANDA.tip)
    accuracy = Accuracy(x=1e-9, x_period=0.02, tool=0.25, jacobian=1e-9)
    watch, faults = SensorWatch(task, DT, accuracy, np.full(3, 0.01), False), set()
    turns = np.eye(7)[6]  # about the axis of the flange, z of the tip
    for k in range(300):
        q, v = START + 2.0 * k * DT * turns, 2.0 * turns
        x = task.value(q) + link.placement(q)[0] @ [share * 0.25, 0.0, 0.0]
        faults.add(watch.look(aj.Measurement(k * DT, q, v, x, k * DT), x))
    assert (faults == {None}) != found


def test_a_sensor_that_is_learnt_may_be_turned():
    """And what it sees be neither longer than the motion of the tip nor shorter."""
    assert looked(lambda t, x: TURN @ x, is_learnt=True)[0] is None
    assert looked(lambda t, x: 1e3 * x, is_learnt=True)[0] is Fault.SENSOR_JUMPED
    shrunk = looked(lambda t, x: 0.4 * x, is_learnt=True, tool=0.0)[0]
    assert shrunk in (Fault.SENSOR_JUMPED, Fault.SENSOR_DISAGREES)


@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_joints_that_turn_about_a_tip_that_is_held_raise_no_alarm(noise):
    belief, sensor = aj.PositionTask(PANDA.with_object(0.0)), aj.PositionTask(TRUTH)
    watch = SensorWatch(belief, DT, Accuracy(x=3e-4, x_period=DT), np.full(3, 0.01), False)
    rng, q = np.random.default_rng(0), START.copy()
    held = sensor.value(q)
    for k in range(600):
        J = sensor.jacobian(q)
        v = (np.eye(7) - np.linalg.pinv(J) @ J) @ np.array([0.5, 0.0, -0.5, 0.0, 0.5, 0.3, 0.0])
        v = v + np.linalg.pinv(J) @ (10.0 * (held - sensor.value(q)))
        q = q + DT * v
        x = held + noise * rng.standard_normal(3)
        assert watch.look(aj.Measurement(k * DT, q, v, x, k * DT), held) is None
    moved = belief.value(q) - belief.value(START)
    assert np.linalg.norm(moved) > 0.01  # which the believed tip is not


@pytest.mark.parametrize(
    "change", [{"q": -1.0}, {"x_period": 0.0}, {"jacobian": math.nan}, {"tool": -0.1}]
)
def test_accuracy_is_checked(change):
    with pytest.raises(aj.InvalidInputError, match=next(iter(change))):
        Accuracy(**change)


@pytest.mark.parametrize(
    ("arm", "kind"),
    [
        ("ur5", "x turned from the start"),
        pytest.param("panda", "x frozen, with noise", marks=pytest.mark.long),
        pytest.param("panda", "encoder frozen, q̇ fades", marks=pytest.mark.study),
        pytest.param("panda", "q̇ held", marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_faults_in_mid_motion_brake_the_arm(arm, kind):
    outcome = study.break_one(study.Case(arm, kind, 7))
    assert study.short([outcome]) == []
    assert study.table([outcome]).count("\n") == 3


@pytest.mark.parametrize(
    ("arm", "kind"),
    [
        # which take seconds: by part in test_monitor.py, and some of them below
        pytest.param(
            arm,
            kind,
            marks=pytest.mark.long if i or kind in SLOW + AS_OTHERS else pytest.mark.study,
        )
        for i, arm in enumerate(study.STARTS)
        for kind in study.KINDS
        if kind not in study.TIMED
    ],
)
def test_every_fault_brakes_every_arm(arm, kind):
    outcome = study.break_one(study.Case(arm, kind, 8))
    assert "FALSE" not in outcome.fault
    if kind not in SLOW:
        assert study.short([outcome]) == []


# the payload, the oscillation and the drift: in test_monitor.py
@pytest.mark.study
@pytest.mark.parametrize(
    ("arm", "kind", "seed", "names"),
    [
        ("ur10", "a motor reversed", 8, {"MOTOR_WEAK"}),  # seed 7: PUSHED after 16 ms, 1 mm
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("z1", "payload of 1.5 kg grasped", 7, {"TOOL_CHANGED"}),
                ("panda", "a motor without power", 7, {"MOTOR_WEAK"}),
                ("baxter_left_arm", "a motor without power", 7, {"MOTOR_WEAK"}),
                ("panda", "a motor reversed", 7, {"MOTOR_WEAK"}),
                ("panda", "a wrist rings", 7, {"OSCILLATES"}),
                # seed 7: PUSHED, as friction turns round while the arm sinks
                ("kinova", "payload of 1.5 kg grasped", 8, {"TOOL_CHANGED"}),
                ("z1", "a motor without power", 7, {"MOTOR_WEAK"}),
                ("xarm7", "x drifts by 2 cm/s", 7, {"NOT_EXPLAINED", "SENSOR_DISAGREES"}),
            )
        ),
    ],
)
def test_what_happens_is_named_on_arms_that_no_threshold_was_chosen_on(
    arm, kind, seed, names, monkeypatch
):
    monkeypatch.setattr(study, "LASTS", 2.5)  # long enough for all of these
    outcome = study.break_one(study.Case(arm, kind, seed))
    assert outcome.fault in names
    if kind in study.MOTORS:
        assert outcome.after < 0.1


class Jumping(study.Broken):
    """An arm with a reversed motor, one of whose encoders jumps 8 ms later."""

    def read(self):
        m = super().read()
        late = self.broken_at is not None and self.driver.t > self.broken_at[0] + 0.0075
        return m._replace(q=m.q + 0.05 * (np.arange(7) == 0)) if late else m


@pytest.mark.parametrize(
    ("kind", "at", "seed"), [("a motor reversed", 0.4, 1), ("q jumps", 0.6377, 2)]
)
def test_a_jump_is_explained_by_what_was_before_it(kind, at, seed):
    """Never by itself: an encoder that jumps is no motor."""
    plant, controller = study.prepared("panda")
    driver = SimulatedDriver(plant, START, pace=math.inf)
    jumping = Jumping(driver, "panda", kind, at, seed)
    goal = plant.sensor.value(START) + study.WAY
    run = aj.control(jumping, controller, goal, 1.0, tolerances=study.tolerances(plant))
    assert run.fault is Fault.POSITION_JUMPED
    assert (f"MOTOR_WEAK: panda_joint{jumping.joint + 1}, " in run.ended) == (kind != "q jumps")
    assert ("MOTOR_WEAK" in run.ended) == (kind != "q jumps")


def test_a_weak_motor_ends_the_loop():
    plant, controller = study.prepared("panda")
    driver = SimulatedDriver(plant, START, pace=math.inf)
    weak = study.Broken(driver, "panda", "a motor at half its torque", 0.4, 1)
    goal = plant.sensor.value(START) + study.WAY
    run = aj.control(weak, controller, goal, 1.0, tolerances=study.tolerances(plant))
    assert run.fault is Fault.MOTOR_WEAK
    assert weak.braked_at[0] - weak.broken_at[0] < 0.1


@pytest.mark.long  # of other runs: test_guard_clean.py
@pytest.mark.parametrize("seconds", [2.5, 60.0])
def test_a_clean_run_has_no_fault(seconds, monkeypatch):
    monkeypatch.setattr(study, "HOURS", study.RUNS * seconds / 3600.0)
    outcome = study.clean(study.Case("ur5", "clean", 100))
    assert outcome.fault == ""
    assert outcome.after > seconds - 1.0


def test_a_joint_that_its_gravity_holds_still_is_not_unanswering():
    still = Accuracy(q=1e-4)
    held = lambda m: m._replace(q=START, v=np.zeros(7))  # noqa: E731
    sent = lambda t: 0.5 * PANDA.effort_limits  # noqa: E731
    assert watched(held, accuracy=still, sent=sent)[0] is None


def test_coarse_encoders_and_noisy_tachometers_at_rest_are_no_fault():
    rng = np.random.default_rng(0)

    def rests(m):
        noise = np.clip(0.01 * rng.standard_normal(7), -0.05, 0.05)
        return m._replace(q=START, v=noise)

    assert watched(rests, seconds=2.0, accuracy=Accuracy(q=1e-4, v=0.01))[0] is None


@pytest.mark.parametrize("dt", [DT, 8e-3])
def test_noise_of_the_tachometer_is_no_fault_at_any_period(dt):
    """It is as large in each period, so that its integral grows with that."""
    rng, accuracy = np.random.default_rng(1), Accuracy(q=1e-6, v=0.01)
    still = lambda m: m._replace(q=START, v=0.01 * rng.standard_normal(7))  # noqa: E731
    assert watched(still, 1000 * dt, dt=dt, accuracy=accuracy)[0] is None


@pytest.mark.parametrize("dt", [DT, 8e-3])
def test_a_joint_that_brakes_until_it_stands_is_no_frozen_encoder(dt):
    """With 20 rad/s² and q̇ of differences, at any period; then q of a good encoder is the same."""
    watch = FaultWatch(PANDA, dt, Accuracy(q=1e-5, v=5e-3), PANDA.velocity_limits, 0.02, False)
    left = dt * np.maximum(7.9 - np.arange(60), 0.0)[:, np.newaxis]  # s, until it stands
    q = START - 10.0 * left**2 * np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    for k, v in enumerate(np.diff(q, axis=0) / dt):
        m = aj.Measurement(k * dt, q[k + 1], v, np.zeros(3))
        assert watch.look(m, 10.0 + k * dt) is None
        watch.commanded(np.zeros(7), None)


COARSE = 2.0 * math.pi / 2**12  # rad, of an encoder of 12 bits


def quantised(m):
    return m._replace(q=np.round(m.q / COARSE) * COARSE)


@pytest.mark.parametrize("size", [0.3, pytest.param(0.02, marks=pytest.mark.study)])
def test_coarse_encoders_of_moving_joints_are_no_fault(size):
    """Where joints turn round, q is the same for many periods, whatever noise q̇ has."""
    rng, accuracy = np.random.default_rng(0), Accuracy(q=COARSE / math.sqrt(12.0), v=0.01)
    watch = FaultWatch(PANDA, DT, accuracy, PANDA.velocity_limits, 0.02, False)
    for k in range(2000):
        q, v = motion(k * DT, size, rate=3.0)
        m = aj.Measurement(k * DT, q, v + 0.01 * rng.standard_normal(7), np.zeros(3))
        assert watch.look(quantised(m), k * DT) is None
        assert watch.commanded(0.1 * PANDA.effort_limits * np.sin(3.0 * k * DT), v) is None


@pytest.mark.parametrize(("moves", "fault"), [(0.004, None), (0.0, Fault.COMMAND_UNANSWERED)])
def test_a_joint_that_moves_less_than_a_step_of_its_encoder_may_be_led_elsewhere(moves, fault):
    """A servo may be slow, but does not stand."""
    accuracy = Accuracy(q=COARSE / math.sqrt(12.0), v=0.01)
    watch = FaultWatch(PANDA, DT, accuracy, PANDA.velocity_limits, 0.02, True)
    found = None
    for k in range(1000):
        t = k * DT
        v = np.full(7, moves)
        found = found or watch.look(quantised(aj.Measurement(t, START + t * v, v, np.zeros(3))), t)
        watch.commanded(np.full(7, 0.15), np.full(7, 0.15))
    assert found is fault


def test_speed_that_grows_as_the_target_leads_is_no_fault():
    def fast(m):
        v = 0.03 * math.exp(m.t / 0.08)
        return m._replace(q=START + 0.08 * (v - 0.03), v=v * np.ones(7))

    accuracy = Accuracy(q=1e-5, v=1e-3)
    for leads in (False, True):
        watch = FaultWatch(PANDA, DT, accuracy, PANDA.velocity_limits, 0.02, False)
        found = []
        for k in range(300):
            m = fast(aj.Measurement(k * DT, START, START, np.zeros(3)))
            found.append(watch.look(m, 10.0 + m.t))
            watch.commanded(np.zeros(7), m.v if leads else None)
        assert (Fault.SPEED_GREW in found) is not leads


def test_a_lost_frame_of_a_late_camera_is_no_blindness():
    """50 ms late at 0.2 m/s are 1 cm already, without anything being lost."""
    task = aj.PositionTask(TRUTH)
    sight = SensorWatch(task, DT, Accuracy(x=2e-3), np.full(3, 0.01), False)
    J = task.jacobian(START)
    v = np.linalg.pinv(J) @ [0.0, 0.2, 0.0]
    lost = []
    for k in range(400):
        t, seen = k * DT, k < 200
        late = START + max(t - 0.05, 0.0) * v
        x = task.value(late) if seen else np.full(3, np.nan)
        fault = sight.look(aj.Measurement(t, START + t * v, v, x, max(t - 0.05, 0.0)), x)
        assert fault is (None if k < 245 else fault)
        lost.append(fault)
    assert Fault.BLIND in lost[245:260]


def test_at_125_hz_a_joint_that_stands_is_found_in_as_many_milliseconds():
    pushed = PANDA.effort_limits * (np.arange(7) == 1)
    fault, t = watched(
        lambda m: m._replace(q=entry(m.q, 1, START[1]), v=entry(m.v, 1, 0.0)),
        dt=8e-3, accuracy=Accuracy(q=1e-5, v=0.02), sent=lambda t: min(t, 0.2) * pushed,
    )  # fmt: skip
    assert fault is Fault.COMMAND_UNANSWERED
    assert t < 0.17, t


# -- each joint, each direction, another arm and another period ------------------------------------

KINOVA = aj.load_robot("kinova")  # with joints that turn without end
ARMS = {
    "panda": (PANDA, START, DT), "ur5": (aj.load_robot("ur5"), UR5, 8e-3),
    "kinova": (KINOVA, KINOVA.random_configuration(np.random.default_rng(0)), 2e-3),
}  # fmt: skip
ACCURATE = Accuracy(q=1e-9, v=1e-9, x=1e-5, tool=0.0, jacobian=0.0, x_period=1.0)


def glided(arm, v, reference=None, periods=4):
    """The faults that a watch finds of joints at a steady velocity, and what it says of the last.

    The former are of measurements, the latter of commands.
    """
    robot, q, dt = ARMS[arm]
    watch = FaultWatch(robot, dt, ACCURATE, robot.velocity_limits, 0.02, reference is not None)
    found = []
    for k in range(periods):
        moved = pin.integrate(robot.model, q, k * dt * v)
        measurement = aj.Measurement(k * dt, moved, v, np.zeros(3))
        looked = watch.look(measurement, 10.0 + k * dt)
        commanded = watch.commanded(np.zeros(robot.nv), reference)
        found += [each for each in (looked, commanded) if each is not None]
    return found, watch.detail


@pytest.mark.parametrize("arm", ARMS)
def test_each_joint_is_too_fast_in_either_direction(arm):
    robot = ARMS[arm][0]
    for j, name in enumerate(robot.joint_names):
        for sign in (1.0, -1.0):
            v = sign * robot.velocity_limits * (np.arange(robot.nv) == j)
            assert glided(arm, 0.99 * v) == ([], "")
            found, detail = glided(arm, 1.01 * v)
            assert set(found) == {Fault.TOO_FAST}
            assert detail.startswith(f"{name}: {abs(1.01 * v[j]):.3g} rad/s, at most ")


@pytest.mark.parametrize("arm", ARMS)
def test_each_joint_is_faster_than_it_is_led_to_be_in_either_direction(arm):
    """By 15 % of its largest speed, or 0.4 rad/s, beyond the joint and the fastest of all."""
    robot = ARMS[arm][0]
    beyond = np.maximum(0.15 * robot.velocity_limits, 0.4)
    for j, name in enumerate(robot.joint_names):
        here, sign = np.arange(robot.nv) == j, 1.0 if j % 2 else -1.0
        for led in (0.05 * here, -0.05 * here, 0.05 * np.roll(here, 1)):
            most = beyond[j] + 2.0 * abs(led[j]) + 0.05
            assert glided(arm, sign * 0.99 * most * here, led) == ([], "")
            found, detail = glided(arm, sign * 1.01 * most * here, led)
            assert set(found) == {Fault.TOO_FAST}
            assert detail.startswith(f"{name}: ")
    assert glided(arm, np.full(robot.nv, 0.99 * beyond.min()), None) == ([], "")


@pytest.mark.parametrize(("share", "fault"), [(0.99, None), (1.01, Fault.TOO_FAST)])
def test_a_slow_joint_that_slides_may_be_faster_by_a_decimetre_a_second(share, fault):
    robot = aj.load_robot("tiago_arm", free="torso_lift_joint")
    slides = np.array(robot.joint_units) == "m"
    assert slides.sum() == 1
    watch = FaultWatch(robot, 1e-3, ACCURATE, np.full(robot.nv, 0.3), 0.02, True)
    q, v, none = robot.neutral(), share * 0.1 * slides, np.zeros(robot.nv)
    for k in range(2):
        there = pin.integrate(robot.model, q, k * 1e-3 * v)
        measurement = aj.Measurement(k * 1e-3, there, v, np.zeros(3))
        assert watch.look(measurement, 10.0 + k * 1e-3) is None
        assert watch.commanded(none, none) is fault


@pytest.mark.parametrize("arm", ARMS)
def test_what_falls_at_the_start_may_be_faster_if_it_is_braked(arm):
    """As under a load that is not known yet: within 0.1 s, up to 0.75 of the largest speed."""
    robot, q, dt = ARMS[arm]
    j, here = 0, np.arange(robot.nv) == 0
    normal, most = max(0.15 * robot.velocity_limits[j], 0.4), 0.75 * robot.velocity_limits[j]

    def stopped(speed, until=0.09):
        watch, q_now = FaultWatch(robot, dt, ACCURATE, robot.velocity_limits, 0.02, False), q
        watch._v_jump = watch._q_jump = np.full(robot.nv, np.inf)
        for k in range(int(until / dt)):
            v = -speed(k * dt) * here
            q_now = pin.integrate(
                robot.model, q_now, 0.5 * dt * (v - speed(max(k - 1, 0) * dt) * here)
            )
            assert watch.look(aj.Measurement(k * dt, q_now, v, v[:3]), 10.0 + k * dt) is None
            if watch.commanded(np.zeros(robot.nv), 0.0 * v) is Fault.TOO_FAST:
                return k * dt, abs(v[j])
        return None

    def falls(to):
        return lambda t: to * (1.0 - math.exp(-t / max(0.02, 6.0 * dt)))

    size = min(0.18, 1e-3 / dt) * most  # of waves that periods show

    def falls_in_waves(t):  # behind a spring: slower and faster again
        return falls(0.8 * most)(t) + size * math.sin(math.pi * t / max(0.02, 6.0 * dt))

    if most > 1.1 * normal:
        assert stopped(falls(0.99 * most)) is None
        assert stopped(falls_in_waves) is None
        # later nothing falls, and what fell is slower and slower
        fades = 0.1 - 0.5 * math.log(1.0 - normal / most)
        assert 0.1 < stopped(falls(most), 2.0)[0] < fades + 3.0 * dt
    _, speed = stopped(falls(1.3 * max(most, normal)))
    assert speed > 0.98 * max(most, normal)
    # what grows faster and faster is no fall that a law brakes
    _, speed = stopped(lambda t: 0.1 * normal * (math.exp(t / 0.02) - 1.0))
    assert speed < 1.5 * normal


@pytest.mark.parametrize(("dt", "bits"), [(2.5e-4, 12), (2e-3, 12), (1e-3, 16), (0.01, 16)])
def test_a_fall_is_seen_late_and_in_steps(dt, bits):
    """By a filter of q̇ and an encoder: no joint is too fast that is braked as it falls."""
    step, lag = 2.0 * math.pi / 2**bits, max(8e-3, 2.0 * dt)
    accuracy = Accuracy(q=step / math.sqrt(12.0), v=step / lag, velocity_filter=lag)
    most, here = 0.55 * PANDA.velocity_limits[0], np.arange(7) == 0

    def found(speed):
        watch = FaultWatch(PANDA, dt, accuracy, PANDA.velocity_limits, 0.02, False)
        watch._v_jump = watch._q_jump = np.full(7, np.inf)
        q = old = v = 0.0
        for k in range(round(0.12 / dt)):
            q += dt * speed(k * dt)
            new = step * round(q / step)
            v, old = v + dt / (lag + dt) * ((new - old) / dt - v), new
            watch.look(aj.Measurement(k * dt, START + new * here, v * here, START[:3]), k * dt)
            if watch.commanded(np.zeros(7), np.zeros(7)) is Fault.TOO_FAST:
                return speed(k * dt)
        return None

    assert found(lambda t: most * min(t / 0.08, 1.0)) is None
    # what grows faster and faster is none, nor what is faster than that
    assert found(lambda t: 0.02 * (math.exp(t / 0.02) - 1.0)) < 0.9 * PANDA.velocity_limits[0]


@pytest.mark.parametrize("arm", ARMS)
def test_what_a_joint_was_led_to_fades(arm):
    """By e in 0.5 s: a joint that stays fast is too fast then, at any period."""
    robot, q, dt = ARMS[arm]
    watch = FaultWatch(robot, dt, ACCURATE, robot.velocity_limits, 0.02, False)
    v = -0.55 * (np.arange(robot.nv) == 0)
    for k in range(1000):
        measurement = aj.Measurement(k * dt, pin.integrate(robot.model, q, k * dt * v), v, v[:3])
        assert watch.look(measurement, 10.0 + k * dt) is None
        led = 0.1 * v / 0.55 if k == 0 else 0.0 * v
        if watch.commanded(np.zeros(robot.nv), led) is Fault.TOO_FAST:
            break
    beyond = max(0.15 * robot.velocity_limits[0], 0.4)
    assert k * dt == pytest.approx(0.5 * math.log(0.3 / (0.55 - beyond)), abs=1.5 * dt)


@pytest.mark.parametrize("arm", ARMS)
def test_each_encoder_may_freeze_in_either_direction(arm):
    """One that is slow enough for its motor to stop it within two periods."""
    robot, q, dt = ARMS[arm]
    for j, name in enumerate(robot.joint_names):
        for sign in (1.0, -1.0):
            watch = FaultWatch(robot, dt, ACCURATE, robot.velocity_limits, 0.02, False)
            v, faults = sign * 30.5 * dt * (np.arange(robot.nv) == j), []
            for k in range(20):
                moved = pin.integrate(robot.model, q, min(k, 5) * dt * v)
                measurement = aj.Measurement(k * dt, moved, v * (k <= 5), np.zeros(3))
                faults.append(watch.look(measurement, 10.0 + k * dt))
                if faults[-1]:
                    break
            assert faults == [None] * (len(faults) - 1) + [Fault.ENCODER_FROZEN]
            assert k == 13  # q of 5 comes eight times more
            assert watch.detail.startswith(f"{name}: 8 times")


@pytest.mark.parametrize("side", [1.0, pytest.param(-1.0, marks=pytest.mark.study)])
def test_a_filter_of_velocities_that_is_known_raises_no_alarm(side):
    """Late by its time constant, whether joints become faster or slower."""
    accuracy = Accuracy(q=1e-5, v=1e-3, velocity_filter=0.01)
    late = lambda m: m._replace(v=motion(m.t - 0.014)[1])  # noqa: E731
    assert watched(late, 2.0, accuracy=accuracy, side=side)[0] is None
    assert watched(late, 2.0, side=side)[0] is Fault.VELOCITY_DISAGREES


@pytest.mark.parametrize("arm", ARMS)
def test_each_joint_answers_within_a_while_where_it_is_led_either_way(arm):
    """By the velocity that it is sent: by 0.02 rad, but for 30 ms at least."""
    robot, q, dt = ARMS[arm]
    still = aj.Measurement(0.0, q, np.zeros(robot.nv), np.zeros(3))
    for j, name in enumerate(robot.joint_names):
        for rate in (0.2, -0.2) if j < 2 else (0.2 * (-1.0) ** j,):
            watch = FaultWatch(robot, dt, Accuracy(), robot.velocity_limits, 0.02, True)
            led = rate * (np.arange(robot.nv) == j)
            for k in range(200):
                if watch.look(still._replace(t=k * dt), 10.0 + k * dt) is not None:
                    break
                watch.commanded(led, None)
            assert k * dt == pytest.approx(0.1, abs=3.0 * dt)
            assert watch.detail == f"{name}: it was led {0.2 * k * dt:.3g} rad"


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("late", [0.0, 0.096])
def test_x_is_held_against_the_joints_when_it_was_taken(arm, late):
    """With all else known to the bit, its time may not be off by as much as it is late."""
    robot, start, dt = ARMS[arm]
    task, phases = aj.PositionTask(robot), np.arange(robot.nv)

    def moved(t):
        way, v = 0.5 * np.sin(4.0 * t + phases), 2.0 * np.cos(4.0 * t + phases)
        return pin.integrate(robot.model, start, way), v

    def first_fault(stamp):
        watch = SensorWatch(task, dt, ACCURATE, np.full(3, 0.01), False)
        for t in dt * np.arange(round(0.6 / dt)):
            x = task.value(moved(t - late)[0])
            if fault := watch.look(aj.Measurement(t, *moved(t), x, stamp(t)), x):
                return fault
        return None

    assert first_fault(lambda t: t - late) is None
    for other in [0.0, 0.192] if late else [0.096]:
        found = first_fault(lambda t, other=other: t - other)
        assert found in (Fault.SENSOR_JUMPED, Fault.SENSOR_DISAGREES)
    assert (first_fault(lambda t: None) is None) is (late == 0.0)


@pytest.mark.parametrize("jumps", [False, True])
def test_a_late_x_is_held_against_the_joints_after_missed_states_too(jumps):
    """Eight states are missed; an x that was taken before them jumps and is found at once."""
    task, late = aj.PositionTask(PANDA), 0.02
    watch, v = SensorWatch(task, DT, Accuracy(x=3e-4), np.full(3, 0.01), False), np.full(7, 0.2)
    found = {}
    for k in (*range(101), *range(109, 150)):
        t, taken = k * DT, (k - 20) * DT
        x = task.value(START + taken * v)
        if jumps and k >= 112:
            x = x + [0.0, 0.02, 0.0]
        found[k] = watch.look(aj.Measurement(t, START + t * v, v, x, t - late), x)
    named = {k: fault for k, fault in found.items() if fault is not None}
    assert min(named, default=None) == (112 if jumps else None)
    assert named.get(112) is (Fault.SENSOR_JUMPED if jumps else None)


def clocked(times, read_at=None):
    """The faults that a watch finds in readings of an arm at rest, at times of its clock."""
    watch = FaultWatch(PANDA, DT, Accuracy(), PANDA.velocity_limits, 0.02, False)
    reads = times if read_at is None else read_at
    rest = START, np.zeros(7), np.zeros(3)
    return [
        watch.look(aj.Measurement(t, *rest), 10.0 + now)
        for t, now in zip(times, reads, strict=True)
    ]


def test_a_clock_may_stand_still_for_less_than_five_periods_whenever_it_does():
    times = DT * np.arange(60.0)
    for begin in (10, 20, 30):  # four readings in vain, each time
        times[begin : begin + 4] = times[begin - 1]
    assert not any(clocked(times))
    times[40:45] = times[39]
    faults = clocked(times)
    assert faults.index(Fault.CLOCK_STOOD_STILL) == 44
    assert not any(faults[:44])


@pytest.mark.parametrize("missed", [0.019, 0.021])
def test_a_state_that_comes_late_is_told_from_a_clock_that_jumps(missed):
    """Late is what took that long by this machine's clock, too."""
    times = DT * np.arange(60.0)
    times[40:] += missed
    late, jumped = clocked(times), clocked(times, DT * np.arange(60.0))
    told = [None, None] if missed < 0.02 else [Fault.TORQUE_LATE, Fault.CLOCK_JUMPED]
    assert [late[40], jumped[40]] == told
    assert not any(late[:40] + late[41:])


@pytest.mark.parametrize("missed", [1, 3])
def test_periods_without_q_do_not_make_what_comes_after_them_late(missed):
    """However soon a state has to come after the one before."""
    watch = FaultWatch(PANDA, DT, Accuracy(), PANDA.velocity_limits, 1.5 * DT, False)
    for k in range(60):
        q, v = motion(k * DT)
        if 30 <= k < 30 + missed:
            q = np.full(7, math.nan)
        assert watch.look(aj.Measurement(k * DT, q, v, np.zeros(3)), 10.0 + k * DT) is None
        watch.commanded(np.zeros(7), None)


def test_a_jump_while_the_clock_stands_still_is_found():
    watch, (q, v) = FaultWatch(PANDA, DT, Accuracy(), PANDA.velocity_limits, 0.02, False), motion(0)
    faults = []
    for k in range(30):
        t = DT * (k - (k >= 20))  # 19 and 20 have the same time
        moved = q + t * v + 0.02 * (k >= 20) * (np.arange(7) == 4)
        faults.append(watch.look(aj.Measurement(t, moved, v, np.zeros(3)), 10.0 + t))
    assert faults.index(Fault.POSITION_JUMPED) == 21
    assert not any(faults[:21])
    assert watch.detail == "" or watch.detail.startswith("panda_joint5: ")


@pytest.mark.parametrize("arm", ARMS)
def test_a_change_of_velocity_is_judged_by_the_period(arm):
    """By 5 % of a joint's largest speed in a millisecond, to either side."""
    robot, q, dt = ARMS[arm]
    for share, fault in ((0.049, None), (-0.049, None), (0.051, 1), (-0.051, 1)):
        watch = FaultWatch(robot, dt, ACCURATE, robot.velocity_limits, 0.02, False)
        step = abs(share) * dt / 1e-3
        faults, way, before = [], np.zeros(robot.nv), np.zeros(robot.nv)
        for k in range(30):
            size = math.copysign(step * min(k, math.floor(0.9 / step)), share)
            v = size * robot.velocity_limits
            way, before = way + 0.5 * dt * (v + before), v
            moved = pin.integrate(robot.model, q, way)
            measurement = aj.Measurement(k * dt, moved, v, np.zeros(3))
            faults.append(watch.look(measurement, 10.0 + k * dt))
        if fault is None:
            assert not any(faults)
        else:
            assert faults.index(Fault.VELOCITY_JUMPED) == fault
            assert not any(faults[:fault])


@pytest.mark.parametrize("dt", [1e-3, 8e-3])
@pytest.mark.parametrize("error", [-0.4, -0.1, 0.1, 0.4])
def test_motions_may_be_off_by_a_share_of_the_way(dt, error):
    """By 15 % of Ĵ along the way of the joints, at any period."""
    robot, q, _ = ARMS["ur5"]
    task, rate = aj.PositionTask(robot), np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.0])
    accuracy = Accuracy(x=1e-5, tool=0.0, jacobian=0.15, x_period=1.0)
    watch, begun = SensorWatch(task, dt, accuracy, np.full(3, 0.01), False), task.value(q)
    found = set()
    for t in dt * np.arange(round(0.4 / dt)):
        x = begun + (1.0 + error) * (task.value(q + t * rate) - begun)
        found.add(watch.look(aj.Measurement(t, q + t * rate, rate, x, t), x))
    assert (found == {None}) is (abs(error) < 0.15)
    assert found <= {None, Fault.SENSOR_JUMPED, Fault.SENSOR_DISAGREES}


@pytest.mark.parametrize(("jacobian", "tool", "is_found"), [
    (1.2, 0.0, True), (2.2, 0.0, False), (0.0, 1.0, True), (0.0, 3.0, False),
])  # fmt: skip
def test_an_x_that_stands_still_may_do_so_by_half_of_what_a_motion_may_be_off(
    jacobian, tool, is_found
):
    """As x is not moved at all, errors of Ĵ and of the tip would have to cancel all of the way."""
    robot, q, _ = ARMS["ur5"]
    task, rate = aj.PositionTask(robot), np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.0])
    accuracy = Accuracy(x=1e-5, tool=tool, jacobian=jacobian)
    watch, still = SensorWatch(task, DT, accuracy, np.full(3, 0.01), False), task.value(q)
    found = set()
    for t in DT * np.arange(400):
        q_t = q + t * rate
        found.add(watch.look(aj.Measurement(t, q_t, rate, still, t), task.value(q_t)))
    assert found == ({None, Fault.SENSOR_FROZEN} if is_found else {None})


def test_tolerances_are_in_the_units_of_the_task():
    usual = aj.realtime.Tolerances().for_task(aj.PoseTask(PANDA), 1e-3)
    np.testing.assert_array_equal(usual.max_error, [0.15] * 3 + [0.5] * 3)
    np.testing.assert_array_equal(usual.max_blind_motion, [0.01] * 3 + [0.04] * 3)
    np.testing.assert_array_equal(usual.accuracy.x, [2e-3] * 6)
    given = aj.realtime.Tolerances(max_error=0.3, max_blind_motion=[0.1, 0.2, 0.3])
    given = given.for_task(aj.PositionTask(PANDA), 1e-3)
    np.testing.assert_array_equal(given.max_error, [0.3] * 3)
    np.testing.assert_array_equal(given.max_blind_motion, [0.1, 0.2, 0.3])
    stopping = {fault for fault in Fault if fault.stops}
    assert stopping == {Fault.TORQUE_LATE, Fault.LIMITS}  # all others brake at once
