"""Break sensors, clocks, drivers and motors in mid-motion, and see what the loop on a robot does.

An arm with an unknown tool (20 cm, 0.5 kg), in MuJoCo behind `SimulatedDriver`, reaches for a
target under `aj.control`. At an instant drawn by a seed something breaks, or something happens to
the arm, of some fifty kinds; where it is one joint's, of a joint that moves. The table gives the
time until the arm is braked, or until the event is known, how much faster the joints were then
than before, and how far the tip moved until then (where motors fail or something happens to the
arm: how far it was from where it is in the same run without). With --clean
hours of runs without a fault, with noise, delays and dropouts, are counted for false alarms.

    python examples/studies/faults.py --out results/faults
    python examples/studies/faults.py --arms kinova xarm7 --out results/faults_of_others
    python examples/studies/faults.py --clean --out results/faults

Thresholds were chosen on panda, ur5, kinova and z1. Exit code 1 means that a fault was not found,
or too late, or that something was found in a clean run.
"""

import functools
import math
import sys
import time
from collections import Counter, deque
from typing import NamedTuple

import numpy as np
from common import head, parser, row, run_all, write

import approxjac as aj
from approxjac.errors import ControlError, InvalidInputError
from approxjac.realtime import Accuracy, SimulatedDriver, Tolerances, control

DT, TOOL, MASS = 1e-3, 0.2, 0.5
WAY = (0.10, -0.15, 0.16)  # from the tip to the target [m]
STARTS = {
    "panda": (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7),
    "ur5": (0.3, -1.2, 1.6, -1.0, -1.4, 0.2),
}
LONGEST, FROZEN, SENSOR = 0.06, 0.15, 0.35  # until the brake [s]
FASTER, FAR = 0.5, 0.02  # joint speed more than before [rad/s], motion of the tip [m]

# what breaks, of which group, and from the first moment where it is to be so
JOINTS = (
    "encoder frozen, q̇ 0", "encoder frozen, q̇ held", "encoder frozen, q̇ fades",
    "all encoders frozen", "q jumps", "q drifts", "q counts backwards", "joints swapped",
    "q̇ of a joint 0", "all q̇ 0", "q̇ held", "q̇ with the wrong sign", "q̇ in degrees",
    "q̇ halved", "q̇ spike", "q̇ very noisy", "q NaN", "q̇ NaN", "q infinite",
)  # fmt: skip
SENSORS = (
    "x frozen", "x frozen, with noise", "x jumps", "x in millimetres", "x turned by 90°",
    "x turned from the start", "x mirrored from the start", "x lost",
)  # fmt: skip
CLOCKS = (
    "clock stands still", "state repeated", "clock jumps", "clock runs backwards",
    "arm at 1.33 of its clock",
)  # fmt: skip
DRIVERS = (
    "read hangs", "send hangs", "torques 50 ms late", "read raises", "send raises",
    "controller raises",
)  # fmt: skip
MOTORS = (
    "a motor reversed", "a motor without power", "a motor at half its torque", "torques doubled",
)  # fmt: skip
EVENTS = {  # what happens, and which conditions say so
    "payload dropped": ("TOOL_CHANGED",),
    "payload of 1.5 kg grasped": ("TOOL_CHANGED",),
    "tip meets a wall": ("PRESSES",),
    "pushed with 20 N for 1 s": ("PUSHED",),
    "cable that pulls with 5 N": ("PUSHED",),
    "a wrist rings": ("OSCILLATES", "TOO_FAST"),
    "x drifts by 2 cm/s": ("SENSOR_DISAGREES", "NOT_EXPLAINED"),
}
TIMED = ("read hangs", "send hangs", "torques 50 ms late")  # which need the clock on the wall
HARMLESS = ("torques doubled",)  # the arm may get there all the same
PUSH, CABLE, WALL = 20.0, 5.0, (5e3, 50.0)  # N; N/m and N s/m
LATE = 5  # periods, by which a wrist is damped too late
HOURS, RUNS = 2.0, 60
LASTS = 4.0  # a run that nothing ends [s]
KINDS = JOINTS + SENSORS + CLOCKS + DRIVERS + MOTORS + tuple(EVENTS)


class Case(NamedTuple):
    """One run."""

    arm: str
    kind: str
    seed: int
    law: str = "set-point"


class Outcome(NamedTuple):
    """What became of it."""

    case: Case
    fault: str
    after: float  # from the fault to the brake [s]
    faster: float  # joint speed at the brake, more than at the fault [rad/s]
    moved: float  # tip, since then; if motors or events, from where it would be without [m]


class Broken:
    """A driver in which something breaks at a time."""

    def __init__(self, driver, arm, kind, at, seed):
        self.driver, self.arm, self.kind, self.at = driver, arm, kind, at
        self.dt, self.command, self.limits = driver.dt, driver.command, driver.limits
        self.adds_gravity = driver.adds_gravity
        self.rng = np.random.default_rng(seed)
        self.joint = 0
        self.before = self.broken_at = self.braked_at = None
        self.hung_at = self.first = None
        self.tips, self.past = {}, []
        if kind.startswith("payload"):  # made here, as a loop has no time for it
            mass = 0.0 if "dropped" in kind else MASS + 1.5
            self.other = plant_with(arm, mass, driver.plant.sensing)
        direction = self.rng.standard_normal(3) * [1.0, 1.0, 0.3]
        self.direction = direction / np.linalg.norm(direction)

    def read(self):
        """Return a measurement, broken from the instant on."""
        measured = self.driver.read()
        late = self.driver.t >= self.at
        self.tips[self.driver.samples] = self.driver.plant.sensor.value(self.driver.q)
        if late and self.broken_at is None:
            self.broken_at = self.state()
            speeds = np.abs(self.driver.v[:-1])
            self.joint = int(self.rng.choice(np.flatnonzero(speeds >= 0.3 * speeds.max())))
        if late or "from the start" in self.kind or "1.33" in self.kind:
            return self.broken(measured)
        self.before = measured
        return measured

    def state(self):
        """Return time, fastest joint and tip of the true arm."""
        driver = self.driver
        return driver.t, np.abs(driver.v).max(), driver.plant.sensor.value(driver.q)

    def broken(self, m):
        """Return a measurement as it is when something is broken."""
        kind, j, since = self.kind, self.joint, self.driver.t - self.at
        q, v, x, t = m.q.copy(), m.v.copy(), m.x.copy(), m.t
        old = self.before or m
        if kind.startswith("encoder frozen"):
            q[j] = old.q[j]
            v[j] = {"0": 0.0, "held": old.v[j]}.get(
                kind.split()[-1], old.v[j] * math.exp(-since / 0.01)
            )
        elif kind == "all encoders frozen":
            q, v = old.q, np.zeros_like(v)
        elif kind == "q jumps":
            q[j] += 0.05
        elif kind == "q drifts":
            q[j] += 0.3 * since
        elif kind == "q counts backwards":
            q[j] = 2.0 * old.q[j] - q[j]
        elif kind == "joints swapped":
            q[[j, j + 1]], v[[j, j + 1]] = q[[j + 1, j]], v[[j + 1, j]]
        elif kind == "q̇ of a joint 0":
            v[j] = 0.0
        elif kind == "all q̇ 0":
            v[:] = 0.0
        elif kind == "q̇ held":
            v = old.v
        elif kind == "q̇ with the wrong sign":
            v[j] = -v[j]
        elif kind == "q̇ in degrees":
            v = np.degrees(v)
        elif kind == "q̇ halved":
            v = 0.5 * v
        elif kind == "q̇ spike":
            v[j] += 2.0 * (since < 1.5 * DT)
        elif kind == "q̇ very noisy":
            v = v + 0.5 * self.rng.standard_normal(len(v))
        elif kind == "q NaN":
            q[j] = math.nan
        elif kind == "q infinite":
            q[j] = math.inf
        elif kind == "q̇ NaN":
            v[j] = math.nan
        elif kind == "x frozen":
            x = old.x
        elif kind == "x frozen, with noise":
            x = old.x + 3e-4 * self.rng.standard_normal(3)
        elif kind == "x jumps":
            x = x + [0.0, 0.1, 0.0]
        elif kind == "x in millimetres":
            x = 1e3 * x
        elif "turned" in kind:
            x = np.array([-x[1], x[0], x[2]])
        elif "mirrored" in kind:
            x = np.array([x[0], -x[1], x[2]])
        elif kind.startswith("x drifts"):
            x = x + 0.02 * since * self.direction
        elif kind == "x lost":
            x = np.full(3, math.nan)
        elif kind == "clock stands still":
            t = old.t
        elif kind == "state repeated":
            return old
        elif kind == "clock jumps":
            t += 1.0
        elif kind == "clock runs backwards":
            t = old.t - since
        elif "1.33" in kind:
            t /= 1.33
        elif kind == "read hangs":
            self.hang(0.4)
        elif kind == "torques 50 ms late":
            self.hang(0.05)
        elif kind == "read raises":
            raise OSError("no answer")
        t_x = None if m.t_x is None else t + m.t_x - m.t
        return m._replace(t=t, q=q, v=v, x=x, t_x=t_x)

    def hang(self, duration):
        """Do not come back for a time [s], once."""
        if self.hung_at is None:
            self.hung_at = time.perf_counter()
            time.sleep(duration)

    def send(self, command):
        """Send a command, broken where motors are."""
        j, command = self.joint, np.array(command)
        if self.first is None:
            self.first = self.driver.t - DT
        if self.broken_at is not None:
            if self.kind == "send hangs":
                self.hang(0.4)
            elif self.kind == "send raises":
                raise OSError("not sent")
            g = self.driver.plant.dynamics.g(self.driver.q)
            if self.kind == "a motor reversed":
                command[j] = -command[j]
            elif self.kind == "torques doubled":
                command = g + 2.0 * (command - g)
            elif self.kind == "a motor without power":
                command[j] = 0.0
            elif self.kind == "a motor at half its torque":
                command[j] *= 0.5
            elif self.kind in EVENTS:
                command = command + self.meddled(self.driver.t - self.broken_at[0])
        self.driver.send(command)

    def meddled(self, since):
        """Return what happens to the arm, as a torque."""
        driver, kind = self.driver, self.kind
        sensor = driver.plant.sensor
        J, x = sensor.jacobian(driver.q), sensor.value(driver.q)
        if kind.startswith("payload"):
            driver.plant = self.other  # from now on it is another arm
        elif kind.startswith("cable") or (kind.startswith("pushed") and since < 1.0):
            return J.T @ ((CABLE if kind.startswith("cable") else PUSH) * self.direction)
        elif kind == "tip meets a wall":
            speed = J @ driver.v
            if not self.past:
                self.past = [x, speed / np.linalg.norm(speed)]
            wall, into = self.past
            depth = (x - wall) @ into
            if depth > 0.0:
                stiffness, damping = WALL
                return -J.T @ (max(0.0, stiffness * depth + damping * (speed @ into)) * into)
        return np.zeros(len(driver.v))

    def brake(self):
        """Brake, and note when."""
        if self.braked_at is None:
            if self.hung_at is not None:  # the arm went on with the last command meanwhile
                self.driver.advance(time.perf_counter() - self.hung_at)
            self.braked_at = self.state()
        self.driver.brake()


class Raising(aj.controllers.ControllerWrapper):
    """A controller with a bug that shows at a time."""

    _memory = 0

    def __init__(self, controller, at):
        self.controller, self.at = controller, at

    def begin(self, measurement):
        """Return that of the controller inside."""
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        """Step the controller inside, or raise an error."""
        if measurement.t >= self.at:
            raise ZeroDivisionError("a bug")
        return self.controller.advance(state, measurement, target, dt)


class Ringing(aj.controllers.ControllerWrapper):
    """A controller that pushes the last joint but one on, from a time on."""

    _memory = 0

    def __init__(self, controller, at):
        self.controller, self.at, self.past = controller, at, deque(maxlen=LATE + 1)

    def begin(self, measurement):
        """Return that of the controller inside."""
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        """Step the controller inside, and add the torque."""
        state, answer = self.controller.advance(state, measurement, target, dt)
        if measurement.t >= self.at:
            self.past.append(measurement.q[-2])
            most = 0.1 * self.task.robot.effort_limits[-2]
            torque = answer.torque.copy()
            speed = (self.past[-1] - self.past[0]) / (LATE * dt)
            torque[-2] += most * np.tanh(speed / 0.02)  # pushes on, as a late damping does
            answer = answer._replace(torque=torque)
        return state, answer


def plant_with(arm, mass, sensing=None):
    """The true arm in MuJoCo, with a tool of a mass."""
    robot = aj.load_robot(arm)
    truth = robot.with_object(TOOL, mass, axis="x")
    # less on light wrists
    light = np.diag(aj.robots.Dynamics(truth).M(aj.Plant(truth).ready_configuration())) / DT
    dry = np.minimum(0.02 * robot.effort_limits, 0.5 * light * 0.05)
    friction = aj.robots.Friction(np.minimum(0.5, 0.3 * light), coulomb=dry)
    return aj.MujocoPlant(
        truth, sensor=aj.PositionTask(truth), friction=friction, sensing=sensing
    )  # fmt: skip


def prepared(arm, sensing=None, law="set-point"):
    """The true arm, and the controller of the believed one."""
    plant, belief = plant_with(arm, MASS, sensing), aj.load_robot(arm).with_object(0.0)
    latency = None
    if sensing is not None:
        latency = aj.Latency(
            image_period=1.0 / sensing.x_rate, image_age=sensing.x_delay,
            velocity_filter=sensing.velocity_filter,
        )  # fmt: skip
    return plant, controller_of(belief, law, latency=latency, drives=aj.robots.Drives())


def controller_of(belief, law, **known):
    """The law of a believed arm, from what is known of the real one's lags and joints."""
    task = aj.PositionTask(belief)
    if law == "tracking":
        controller = aj.TrackingController(task, **known)
    else:
        controller = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief), **known)
    return aj.TorqueLimited(controller, aj.Limits.of(belief))


def start_of(arm, plant):
    """Where the arm begins."""
    return np.array(STARTS[arm]) if arm in STARTS else plant.ready_configuration()


def tolerances(plant, slow=False):
    """What is told of the sensors; time on the wall counts where a fault is one of it."""
    accuracy = Accuracy(
        q=1e-5, v=1e-3, x=3e-4, x_period=1.0 / 60.0, stiction=0.03 * plant.robot.effort_limits
    )
    return Tolerances(accuracy, max_period=0.02 if slow else 0.5)


@functools.cache
def undisturbed(arm, law):
    """Return the tip of each sample of a run without a fault."""
    plant, controller = prepared(arm, law=law)
    driver = SimulatedDriver(plant, start_of(arm, plant), pace=math.inf)
    quiet = Broken(driver, arm, "nothing", math.inf, 0)
    goal = plant.sensor.value(driver.q) + WAY
    control(quiet, controller, goal, LASTS, tolerances=tolerances(plant))
    return quiet.tips


def break_one(case):
    """Run one case."""
    # only one that learns knows what to expect of x
    law = "tracking" if case.kind.startswith("x drifts") else case.law
    plant, controller = prepared(case.arm, law=law)
    rng = np.random.default_rng([case.seed, KINDS.index(case.kind)])
    at = float(rng.uniform(0.25, 1.0))  # while it moves
    if case.kind in EVENTS:
        at = 0.6 + 0.5 * (at - 0.25)  # when the load at the tip is known
    start = start_of(case.arm, plant)
    if "from the start" in case.kind or "1.33" in case.kind:
        at = 0.0
    slow = case.kind in TIMED
    driver = SimulatedDriver(plant, start, pace=1.0 if slow else math.inf)
    broken = Broken(driver, case.arm, case.kind, at, case.seed)
    goal = plant.sensor.value(start) + WAY
    if case.kind.startswith("x turned from"):
        goal = np.array([-goal[1], goal[0], goal[2]])
    elif "mirrored" in case.kind:
        goal = goal * [1.0, -1.0, 1.0]
    if case.kind == "controller raises":
        controller = Raising(controller, at)
    elif case.kind == "a wrist rings":
        controller = Ringing(controller, at)
    try:
        duration = 2.0 * LASTS if case.kind == "a wrist rings" else LASTS
        run = control(broken, controller, goal, duration, tolerances=tolerances(plant, slow))
    except ControlError as error:
        run = error.given
    except InvalidInputError as error:
        return Outcome(case, f"refused: {error}", 0.0, 0.0, 0.0)
    if broken.broken_at is None:
        return Outcome(case, f"FALSE ALARM {run.fault_name}", 0.0, 0.0, 0.0)
    t0, speed0, x0 = broken.broken_at
    t1, speed1, x1 = broken.braked_at
    found = run.fault_name
    if "from the start" in case.kind or "1.33" in case.kind:
        t0, x0 = 0.0, plant.sensor.value(start)
    elif case.kind in EVENTS or case.kind in MOTORS:
        events = [e for e in run.events if e.named + broken.first > t0]
        if events and (not found or events[0].named + broken.first <= t1):
            found, t1 = events[0].condition.name, events[0].named + broken.first
            x1 = broken.tips[round(t1 / DT)]
    if case.kind in MOTORS or case.kind in EVENTS:
        ways = undisturbed(case.arm, law)
        x0 = ways.get(round(t1 / DT), ways[max(ways)])
    return Outcome(case, found, t1 - t0, speed1 - speed0, float(np.linalg.norm(x1 - x0)))


def clean(case):
    """Run without a fault, with what sensors and motors have; return what ended it, if early."""
    plant, controller = prepared(
        case.arm,
        aj.Sensing(
            x_noise=5e-4, x_rate=60.0, x_delay=0.03, x_dropout=0.05, q_noise=1e-5,
            velocity_filter=2e-3,
        ),
    )  # fmt: skip
    rng = np.random.default_rng(case.seed)
    start = start_of(case.arm, plant)
    driver = SimulatedDriver(plant, start, pace=math.inf, seed=case.seed)
    goals = plant.sensor.value(start) + rng.uniform(-0.15, 0.15, (20, 3))
    # machine code: hours of it in minutes
    controller = aj.codegen.compiled(
        aj.TorqueLimited(controller.controller, aj.Limits(effort=plant.robot.effort_limits))
    )
    path = aj.Waypoints(np.vstack([plant.sensor.value(start), goals]), 0.15, 0.5)
    accuracy = Accuracy(
        q=1e-5, v=0.01, x=5e-4, x_period=1.0 / 20.0, velocity_filter=2e-3,
        stiction=0.03 * plant.robot.effort_limits,
    )  # fmt: skip
    run = control(
        driver,
        controller,
        path,
        HOURS / RUNS * 3600.0,
        tolerances=Tolerances(accuracy, max_period=5.0),
    )
    found = run.fault_name or ", ".join(sorted({str(e.condition) for e in run.events}))
    return Outcome(case, found, float(run.t[-1]), 0.0, 0.0)


def table(outcomes):
    """Return a row a kind, with the worst of its runs."""
    lines = head("what breaks", "known after [ms]", "joints faster [rad/s]", "tip [mm]", "found as")
    for kind in KINDS:
        of = [o for o in outcomes if o.case.kind == kind]
        if not of:
            continue
        counts = Counter(o.fault or "nothing" for o in of)
        names = sorted(counts.items(), key=lambda each: (-each[1], each[0]))
        found = ", ".join(
            f"{name} ({n} of {len(of)})" if n < len(of) else name for name, n in names
        )
        worst = "", "", ""
        if known := [o for o in of if o.fault]:
            sizes = [max(getattr(o, name) for o in known) for name in Outcome._fields[2:]]
            worst = f"{1e3 * sizes[0]:.0f}", f"{sizes[1]:.2f}", f"{1e3 * sizes[2]:.0f}"
        lines.append(row(kind, *worst, found))
    return "\n".join(lines) + "\n"


def short(outcomes):
    """Return in words which runs fell short of what is wanted."""
    found = []
    for o in outcomes:
        if o.case.kind in EVENTS:
            if o.fault not in EVENTS[o.case.kind]:
                found.append(f"{o.case.arm}, {o.case.kind}, seed {o.case.seed}: {o.fault}")
            continue
        longest = LONGEST if o.case.kind in JOINTS else SENSOR
        longest = FROZEN if "encoder" in o.case.kind else longest
        if o.case.kind in HARMLESS and not o.fault:
            continue
        if not o.fault or o.after > longest or o.faster > FASTER or o.moved > FAR:
            found.append(
                f"{o.case.arm}, {o.case.kind}, seed {o.case.seed}: {o.fault or 'nothing'} after "
                f"{1e3 * o.after:.0f} ms, {o.faster:.2f} rad/s faster, {1e3 * o.moved:.0f} mm"
            )
    return found


def main(arguments=None):
    """Run all cases, write the tables, and return the exit code."""
    options = parser(__doc__, "results/faults")
    options.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    options.add_argument("--seeds", type=int, default=5, help="instants at which it breaks")
    options.add_argument("--arms", nargs="+", default=list(STARTS), help="names of robots")
    options.add_argument("--law", choices=("set-point", "tracking"), default="set-point")
    options.add_argument("--clean", action="store_true", help="runs without a fault")
    args = options.parse_args(arguments)
    if args.clean:
        runs = 2 if args.quick else RUNS
        cases = [
            Case(arm, "clean", seed) for seed in range(runs // len(args.arms)) for arm in args.arms
        ]
        outcomes = run_all(clean, cases, args.jobs)
        alarms = [o for o in outcomes if o.fault]
        hours = sum(o.after for o in outcomes) / 3600.0
        told = f"{hours:.2f} h in {len(outcomes)} clean runs: {len(alarms)} false alarms"
        for o in alarms:
            told += f"\n{o.case.arm}, seed {o.case.seed}: {o.fault} at {o.after:.1f} s"
        write(args.out, {"clean_runs.md": told + "\n"}, {"outcomes": outcomes})
        return 1 if alarms else 0
    seeds = 1 if args.quick else args.seeds
    # what is timed by the clock runs alone
    cases = [Case(a, k, s, args.law) for k in args.kinds for a in args.arms for s in range(seeds)]
    timed = [case for case in cases if case.kind in TIMED]
    others = [case for case in cases if case.kind not in TIMED]
    outcomes = run_all(break_one, others, args.jobs) + run_all(break_one, timed, 1)
    fell = short(outcomes)
    text = table(outcomes) + "".join(f"\nfalls short: {line}" for line in fell)
    write(args.out, {"faults.md": text + "\n"}, {"outcomes": outcomes})
    return 1 if fell else 0


if __name__ == "__main__":
    sys.exit(main())
