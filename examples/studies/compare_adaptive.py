"""Beside Marinho and Adorno's adaptive kinematic control, with the same arm, errors and sensor.

M. M. Marinho and B. V. Adorno, "Adaptive constrained kinematic control using partial or complete
task-space measurements" (IEEE Transactions on Robotics 38(6), 2022), as its authors publish it:

    pip install --pre marinholab-papers-tro2022-adaptivecontrol dqrobotics

A Panda that differs from its drawing as real ones do follows 24 lines in 40 s, as `track_real.py`
says. Sensors and errors:

- tracker: positions with 1 mm of noise, at 60 Hz, 30 ms late; a tool of 20 cm is unknown, and a
  tracker that is turned by 60°.
- exact: the same errors, and positions without noise or delay at every step.
- near: the tracker's noise and delay, but the tool is off by 1 cm only and the tracker turned by
  10°, as in their example.
- pose: as near, with exact poses at every step (ours takes their positions only).

Theirs learns Denavit and Hartenberg's four numbers of each joint, base and effector, within bounds
of four standard deviations; q̇ goes to a servo without lag, as does ours at velocity level. It
takes a pose as target: the orientation is that of the drawing where it would be at q between the
configurations of the way-points, so that it can be reached, and moves all joints. "As published"
has the gains of their example (20, a damping of 0.01) and its period of 80 ms. "Tuned" has 8 ms,
for the task a gain of 40, a damping of 1e-4 and a target that is ahead by the lag of that gain
(0.15 mm behind with the right model), x paired with the q at which it was taken, and a gain of
learning of one over the time between frames: of a twentieth of it to the whole, on seeds 20 and
22, the one with the smallest error of the path. "Free" leaves out their constraint by which
learning may not raise the task error, which stops it while a target moves.

    python examples/studies/compare_adaptive.py --out results/compare_adaptive
"""

import json
import sys
from functools import cache

import numpy as np
import pinocchio as pin
from common import head, parser, row, two_digits, write
from track_real import FIRST, NOISE, SD, SD_ORIGINS, Arm
from tracks import DELAY, OFFSET, RATE

import approxjac as aj
from approxjac.codegen import compiled
from approxjac.controllers import AdaptiveKinematics
from approxjac.simulation import Sensing
from approxjac.tasks import TrackerTask

TIME, DT = 40.0, 8e-3  # of velocity commands [s]
SEEDS = 6  # even ones, with a tracker turned by 60°
AT = 5.0, 10.0, 20.0, 40.0  # when the model is looked at elsewhere [s]
SETTINGS = "tracker", "exact", "near", "pose"
OURS = "ours, velocity", "ours, torque"
PUBLISHED, TUNED, FREE = "theirs, as published", "theirs, tuned", "theirs, tuned and free"
ALL = *OURS, PUBLISHED, TUNED, FREE
_H = 0.5 * np.pi
DH = np.array([  # of a Panda: θ, d, a, α of each joint, and 0 for a turning one
    [0.0] * 7,
    [0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0],
    [0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088, 0.0],
    [-_H, _H, _H, -_H, _H, _H, 0.0],
    [0.0] * 7,
])  # fmt: skip


class Panda(Arm):
    """A Panda as it is, its path, and where the drawing would be along it."""

    def __init__(self, setting, seed):
        super().__init__("panda", "way-points", seed)
        if setting in ("near", "pose"):
            self.truth = self.belief.with_object(0.01, axis="x").with_kinematic_error(*self.errors)
            self.turn = self.turn / 6.0
            self.tracker = TrackerTask(self.truth, self.turn, 0.5 * np.array(OFFSET))
            self.R = pin.exp3(self.turn)
        self.path, self.setting = self.waypoints("panda"), setting
        self.tip = aj.PositionTask(self.belief)
        self.is_exact = setting in ("exact", "pose")
        around = np.random.default_rng(0)
        self.elsewhere_q = [self.around(0.7, around) for _ in range(200)]
        self.elsewhere_x = np.array([self.tracker.value(q) for q in self.elsewhere_q])

    def planned(self, t):
        """Return q of the drawing on the straight way between two way-points."""
        x, points = self.path.at(t).x, self.path.points
        k = int(np.searchsorted(self.path._starts, t, side="right")) - 1
        k = min(max(k, 0), len(points) - 2)
        share = np.linalg.norm(x - points[k]) / np.linalg.norm(points[k + 1] - points[k])
        (start, q), tip = self.stops[k : k + 2], self.tip
        goal = tip.value(start) + share * (tip.value(q) - tip.value(start))
        q = start + share * (q - start)
        for _ in range(3):
            q = q + np.linalg.pinv(tip.jacobian(q, None)) @ (goal - tip.value(q))
        return q

    def turned(self, q):
        """Return the true orientation of the tip, in the tracker's axes."""
        return self.R @ placed(self.truth, q).rotation

    def off(self, predicted):
        """Return the median error of a model elsewhere [mm]."""
        x = np.array([predicted(q) for q in self.elsewhere_q])
        return 1e3 * float(np.median(np.linalg.norm(x - self.elsewhere_x, axis=1)))


def placed(robot, q):
    """Return the placement of a robot's tip."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.configuration(q))
    return data.oMf[robot.model.getFrameId(robot.tip)]


class Theirs:
    """Their controller of a velocity; one with its own gains learns, another one moves."""

    def __init__(self, arm, who):
        import dqrobotics as dq
        import marinholab.papers.tro2022.adaptive_control as adaptive

        self.dq, self.of, self.arm, self.is_free = dq, adaptive, arm, who == FREE
        self.is_published = who == PUBLISHED
        self.dt = 0.08 if self.is_published else DT
        gain, damping = (20.0, 0.01) if self.is_published else (40.0, 1e-4)
        learning = gain if self.is_published else 1.0 / DT if arm.is_exact else RATE
        self.ahead = 0.0 if self.is_published else 1.0 / gain
        self.model = model = their_model(arm.belief)
        speeds = arm.belief.velocity_limits
        # no joint comes near its stops, from which theirs keeps by more than a law has to
        model.set_lower_q_limit(np.full(7, -_H * 4.0))
        model.set_upper_q_limit(np.full(7, _H * 4.0))
        model.set_lower_q_dot_limit(-speeds)
        model.set_upper_q_dot_limit(speeds)
        model.set_parameter_space(self._parameters())
        self.learnt = np.array(model.get_parameter_space_values())
        space = adaptive.MeasureSpace.Pose if arm.setting == "pose" else None
        space = space or adaptive.MeasureSpace.Translation
        self._gains = [  # kept, as the controllers refer to them
            adaptive.Example_SimulationParameters(space, each, 5, 0.02, damping, self.dt, TIME)
            for each in (gain, learning)
        ]
        self.mover, self.learner = (adaptive.AdaptiveController(model, g) for g in self._gains)

    def _parameters(self):
        """Return all parameters, with bounds of four standard deviations."""
        kinds = self.of._core._ParameterSpaceEDH
        wide = self.arm.setting in ("tracker", "exact")
        base, effector = ((0.3, _H), (0.6, _H)) if wide else ((0.1, 0.35), (0.02, 0.1))
        lengths, angles = 4.0 * SD_ORIGINS, 4.0 * SD["encoder"]
        model, found = self.model, []

        def add(joint, name, value, most):
            kind = getattr(kinds.Example_ParameterType, name)
            found.append(kinds.Example_Parameter(joint, kind, value, value - most, value + most))

        pose = ("x", 0), ("y", 0), ("z", 0), ("alpha", 1), ("beta", 1), ("gamma", 1)
        for (name, i), each in zip(pose, model.get_base_parameters(), strict=True):
            add(-1, f"base_{name}", each.value_, base[i])
        for joint in range(7):
            for name in ("theta", "d", "a", "alpha"):
                most = lengths if name in "da" else angles
                add(joint, name, getattr(model, f"get_{name}")(joint), most)
        for (name, i), each in zip(pose, model.get_effector_parameters(), strict=True):
            add(7, f"eff_{name}", each.value_, effector[i])
        return found

    def target(self, t):
        """Return the pose to go to: at the path, turned as planned."""
        q, x = self.arm.planned(t + self.ahead), self.arm.path.at(t + self.ahead).x
        if self.arm.setting == "pose":
            return their_pose(self.arm.turned(q), x)
        r = self.dq.rotation(self.model.fkm(q))
        return r + 0.5 * self.dq.E_ * self.dq.DQ([0.0, *x]) * r

    def learn(self, t, q, frame, since):
        """Change what is learnt by a frame."""
        _, q_then, x = frame
        q_then = q if self.is_published else q_then
        R = self.arm.turned(q_then) if self.arm.setting == "pose" else np.eye(3)
        goal = self.model.fkm(q_then) if self.is_free else self.target(t)
        only = self.of.Example_AdaptiveControlStrategy.MEASUREMENT_ONLY
        rates = self.learner.compute_setpoint_control_signal(
            only, q_then, goal, their_pose(R, x), []
        )[1]
        self.learnt = self.learnt + since * np.ravel(rates)
        self.model.set_parameter_space_values(self.learnt)

    def command(self, t, q, v, frame, since):
        """Return q̇, having learnt from a frame if there is a new one."""
        if since:
            self.learn(t, q, frame, since)
        only = self.of.Example_AdaptiveControlStrategy.TASK_ONLY
        nothing = self.dq.DQ([0.0])
        return np.ravel(
            self.mover.compute_setpoint_control_signal(only, q, self.target(t), nothing, [])[0]
        )

    def predicted(self, q):
        """Return where the learnt model's tip is, in the tracker's axes."""
        return np.array(self.dq.translation(self.model.fkm(q)).q[1:4])


def their_pose(R, p):
    """Return a placement as a dual quaternion."""
    import dqrobotics as dq

    q = pin.Quaternion(R)
    r = dq.DQ([q.w, q.x, q.y, q.z])
    return r + 0.5 * dq.E_ * dq.DQ([0.0, *p]) * r


def their_model(robot):
    """Return a Panda by its DH parameters, with the effector that the drawing has."""
    import dqrobotics as dq
    from marinholab.papers.tro2022.adaptive_control import SerialManipulatorEDH

    model, zero = SerialManipulatorEDH(DH), np.zeros(7)
    model.set_base_frame(dq.DQ([1.0]))
    model.set_effector_frame(dq.DQ([1.0]))
    flange = model.fkm(zero)
    R = pin.Quaternion(*dq.rotation(flange).q[:4]).toRotationMatrix()
    end = pin.SE3(R, np.array(dq.translation(flange).q[1:4])).actInv(placed(robot, zero))
    model.set_effector_frame(their_pose(end.rotation, end.translation))
    return model


@cache
def law_of(command, is_exact):
    """Return a law, and its machine code."""
    dt = DT if command == "velocity" else 1e-3
    kinematics = AdaptiveKinematics(
        aj.PositionTask(aj.load_robot("panda")),
        ("tool", "origins", "axes", "camera"),
        sd={"origins": SD_ORIGINS},
        noise=0.1 * NOISE if is_exact else NOISE,
        delay=0.0 if is_exact else DELAY,
        dt=dt,
    )
    options = {"latency": aj.Latency(period=dt)} if command == "torque" else {}
    task = kinematics.task
    law = aj.TrackingController(task, kinematics=kinematics, dt=dt, command=command, **options)
    return law, compiled(law)


class Ours:
    """The tracking law with learnt kinematics."""

    def __init__(self, arm, command):
        self.arm, self.state = arm, None
        self.law, self.code = law_of(command, arm.is_exact)
        self.dt = self.law.dt

    def command(self, t, q, v, frame, since):
        """Return q̇."""
        taken, _, x = frame
        seen, target = aj.Measurement(t, q, v, x, taken), self.arm.path.at(t)
        self.state = self.law.initial_state(seen) if self.state is None else self.state
        self.state, answer = self.code.step(self.state, seen, target, self.dt)
        return answer.torque

    def predicted(self, q):
        """Return where the learnt model's tip is, in the tracker's axes."""
        return self.model(self.state)(q)

    def model(self, state):
        """Return a function of q that predicts x by a state."""
        kinematics, state = self.law.kinematics_of(state)
        learnt = dict(zip(kinematics.names, kinematics.learnt(state), strict=True))
        R = pin.exp3(np.array([learnt[f"camera.r{axis}"] for axis in "xyz"]))
        b = np.array([learnt[f"offset.{axis}"] for axis in "xyz"])
        tip = aj.PositionTask(kinematics.robot(state))
        return lambda q: R @ tip.value(q) + b


def with_velocities(arm, one):
    """Return times, errors of the path [mm] and of the model elsewhere, at velocity level."""
    dt, rng = one.dt, np.random.default_rng([79, arm.seed])
    noise, delay = (0.0, 0.0) if arm.is_exact else (NOISE, DELAY)
    period = dt if arm.is_exact else max(dt, 1.0 / RATE)
    q, v, gone, shown, last = arm.q0, np.zeros(7), [arm.q0], 0.0, -period
    errors, looks = [], {}
    for k in range(round(TIME / dt)):
        t, since = k * dt, 0.0
        if t >= shown - 1e-9:
            taken, since, shown, last = max(t - delay, 0.0), t - last, shown + period, t
            i = min(int(taken / dt), k)
            q_then = gone[i] + (taken / dt - i) * (gone[min(i + 1, k)] - gone[i])
            frame = taken, q_then, arm.tracker.value(q_then) + noise * rng.normal(size=3)
        v = one.command(t, q, v, frame, since)
        errors.append(np.linalg.norm(arm.tracker.value(q) - arm.path.at(t).x))
        q = q + dt * v
        gone.append(q)
        looks |= {at: arm.off(one.predicted) for at in AT if t < at <= t + dt + 1e-9}
    return dt * np.arange(len(errors)), 1e3 * np.array(errors), looks


def with_torques(arm, one):
    """Return the same of a run at torque level, with motors as they are."""
    sensing = Sensing(x_noise=NOISE, x_rate=RATE, x_delay=DELAY)
    sensing = Sensing() if arm.is_exact else sensing
    limits = arm.truth.effort_limits
    plant = aj.Plant(arm.truth, arm.tracker, sensing=sensing, torque_limits=limits)
    run = aj.simulate(
        plant, one.code, arm.path, arm.q0, duration=TIME, dt=one.dt,
        record_every=0.01, seed=arm.seed,
    )  # fmt: skip
    ends = [(at, int(np.argmin(np.abs(run.t - at)))) for at in AT]
    looks = {at: arm.off(one.model(run.state[i])) for at, i in ends}
    return run.t, 1e3 * run.error_norm, looks


def run_one(setting, who, seed):
    """Return the figures of a run [mm]."""
    arm = Panda(setting, seed)
    if who in OURS:
        command = who.partition(", ")[2]
        runs = with_torques if command == "torque" else with_velocities
        ran = runs(arm, Ours(arm, command))
    else:
        ran = with_velocities(arm, Theirs(arm, who))
    t, errors, looks = ran

    def rms(begin, end):
        return float(np.sqrt(np.mean(errors[(t >= begin) & (t <= end)] ** 2)))

    return {"early": rms(5.0, 10.0), "late": rms(30.0, 40.0)} | {f"{at:g}": looks[at] for at in AT}


def table(kept):
    """Return rows of Markdown: medians of the seeds, and the worst."""
    names = [f"elsewhere after {at:g} s" for at in AT]
    lines = head("sensor, errors", "law", "path, 5–10 s", "path, 30–40 s", *names)
    for (setting, who), runs in kept.items():
        shown = []
        for key in ("early", "late", *(f"{at:g}" for at in AT)):
            values = [run[key] for run in runs]
            middle, most = two_digits(np.median(values)), two_digits(max(values))
            shown.append(f"{middle} ({most}) mm")
        lines.append(row(setting, who, *shown))
    return lines


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/compare_adaptive")
    options.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=SETTINGS)
    options.add_argument("--laws", nargs="+", default=list(ALL), choices=ALL)
    options.add_argument("--seeds", type=int, default=SEEDS, help="of each")
    given, kept = options.parse_args(arguments), {}
    given.out.mkdir(parents=True, exist_ok=True)
    for setting in given.settings:
        noisy = setting in ("tracker", "near")  # others need no second level of ours
        for who in (each for each in given.laws if noisy or each != OURS[1]):
            file = given.out / f"{setting} {who} {given.seeds}.json".replace(" ", "_")
            if not file.exists():
                seeds = [FIRST + 2 * i for i in range(given.seeds)]
                file.write_text(json.dumps([run_one(setting, who, seed) for seed in seeds]))
            kept[setting, who] = json.loads(file.read_text(encoding="utf-8"))
    summary = [[*key, runs] for key, runs in kept.items()]
    text = "\n".join(table(kept)) + "\n"
    write(given.out, {"compare_adaptive.md": text}, {"cells": summary})
    return 0


if __name__ == "__main__":
    sys.exit(main())
