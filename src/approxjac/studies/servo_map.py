"""How much roll is tolerated with which gain ratio: the local test beside simulations.

A Panda, one point, an eye to hand; the believed focal length, depth and tool are wrong, gravity is
exact. Two loops are tested: the continuous one with an ideal camera, and that of `servo` with a
camera of 30 Hz that is late and noisy, which the local test knows as a mere delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers import ControllerWrapper, Gains, HeldMeasurement, SetpointController
from approxjac.errors import InvalidInputError, SimulationError
from approxjac.interface import Controller, Evaluation, Measurement, Target
from approxjac.simulation import Plant, Sensing, simulate
from approxjac.stability import LocalStability, local_stability
from approxjac.studies import servo
from approxjac.studies.processes import run_in_processes
from approxjac.studies.servo_result import Servo
from approxjac.studies.servo_settings import ServoSettings
from approxjac.tasks import Task
from approxjac.validation import Array

ROLLS = tuple(10.0 * i for i in range(13))  # [deg]
RATIOS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # k_p / k_v [1/s]
SETTINGS = ServoSettings(focal_factor=1.3, depth_factor=1.5)

Loop = Literal["ideal", "late"]
Verdict = Literal["converges", "diverges", "undecided"]
LOOPS: tuple[Loop, ...] = ("ideal", "late")

_DT = 1.0 / SETTINGS.rate
START = {"ideal": 5.0, "late": 20.0}  # distance of the start's image from the goal's [px]
_EVERY = 10  # samples from one look at a run to the next
_LONG = 1.0  # how long an error has to stay small [s]
_SHRUNK = 0.05  # of the start, without noise
_GROWN = 3.0  # times the start
_LONGEST = 10.0  # of a run [s]
_CHANGED = 0.1  # by which the error must change from the middle third to the last to be judged
_HARDEST = 80.0  # roll around which runs are longest [deg]


class Case(NamedTuple):
    """An error of the roll [deg] and the seed of a goal, with all gain ratios [1/s] to try."""

    roll: float
    goal: int
    ratios: tuple[float, ...] = RATIOS


class Cell(NamedTuple):
    """One loop with one roll, gain ratio and goal.

    Attributes:
        loop: "ideal" or "late".
        roll: Error of the believed roll [deg].
        ratio: a = k_p / k_v [1/s].
        goal: Seed of the goal.
        decay_rate: Of the slowest error as the local test has it, negative where it grows [1/s].
        singular: Whether the local test does not decide.
        verdict: Of the simulated run.
        duration: Until it was decided [s].
        end: RMS error over its last second, as a share of the start's.
        moved: How far the joints were from the goal's posture at the end, ‖Δq‖ [rad].
        end_rate: Decay rate of the local test at the posture where a run converged, on a redundant
            arm another one than the goal's; NaN elsewhere [1/s].
    """

    loop: Loop
    roll: float
    ratio: float
    goal: int
    decay_rate: float
    singular: bool
    verdict: Verdict
    duration: float
    end: float
    moved: float
    end_rate: float

    @property
    def predicted(self) -> Verdict:
        """What the local test says."""
        if self.singular:
            return "undecided"
        return "converges" if self.decay_rate > 0.0 else "diverges"


def cases(goals: int) -> list[Case]:
    """Return the cases of the map, those with the longest runs first.

    Raises:
        InvalidInputError: A negative number of goals.
    """
    if goals < 0:
        raise InvalidInputError(f"map_goals must be at least 0, got {goals}", given=goals)
    rolls = sorted(ROLLS, key=lambda roll: abs(roll - _HARDEST))
    return [Case(roll, goal) for roll in rolls for goal in range(goals)]


def run(
    cases: Sequence[Case], jobs: int | None = None, progress: Callable[[], None] | None = None
) -> list[Cell]:
    """Test and simulate cases in several processes."""
    return list(chain.from_iterable(run_in_processes(run_case, cases, jobs, progress)))


def run_case(case: Case) -> list[Cell]:
    """Test and simulate both loops with one roll and goal and every gain ratio."""
    ready, q_goal = prepared(case.roll, case.goal)
    cells = []
    for ratio in case.ratios:
        controller = with_ratio(ready, ratio)
        for loop in LOOPS:
            test = local_test(loop, ready, controller, q_goal)
            watch = simulated(loop, ready, controller, q_goal, case.goal)
            end_rate = math.nan
            if watch.judged() == "converges":
                end_rate = local_test(loop, ready, controller, watch.q).decay_rate
            moved = pin.difference(ready.plant.robot.model, q_goal, watch.q)
            cells.append(
                Cell(
                    loop,
                    case.roll,
                    ratio,
                    case.goal,
                    test.decay_rate,
                    test.singular,
                    watch.judged(),
                    watch.duration,
                    watch.end,
                    float(np.linalg.norm(moved)),
                    end_rate,
                )
            )
    return cells


def prepared(roll: float, goal: int) -> tuple[Servo, Array]:
    """The arm, the cameras and the default gains with a roll [deg]; and the posture of a goal.

    The posture is that of the seed without roll, the same for all.
    """
    settings = replace(SETTINGS, roll=math.radians(roll), seed=goal)
    return servo.prepare("panda", settings), _goal(goal)


@lru_cache(maxsize=16)
def _goal(seed: int) -> Array:
    return servo.prepare("panda", replace(SETTINGS, seed=seed)).q_goal


def with_ratio(ready: Servo, ratio: float) -> SetpointController:
    """The controller with K_p = a K_v, K_v and the damping as they are."""
    controller = ready.controller
    assert isinstance(controller, SetpointController)  # as it was prepared
    task, gains = controller.task, controller.gains
    kv = gains.diagonals(task.m, task.robot.nv).kv
    return SetpointController(
        task, Gains(kp=ratio * kv, kv=kv, damping=gains.damping), gravity=controller.gravity
    )


def local_test(
    loop: Loop, ready: Servo, controller: SetpointController, q_goal: Array
) -> LocalStability:
    """What the local test says of a loop.

    Of images that are held until the next it knows their mean age, half a frame more than the
    latency; of noise and of motors that saturate it knows nothing.
    """
    truth, sensor = ready.plant.robot, ready.sensor
    if loop == "ideal":
        return local_stability(Plant(truth, sensor), controller, q_goal)
    age = ready.settings.latency + 0.5 / ready.settings.frame_rate
    plant = Plant(truth, sensor, sensing=Sensing(x_delay=age))
    return local_stability(plant, controller, q_goal, dt=_DT)


def simulated(
    loop: Loop, ready: Servo, controller: SetpointController, q_goal: Array, seed: int
) -> Watch:
    """Run a loop from a start near the goal, until its fate is decided."""
    sensor, distance = ready.sensor, START[loop]
    plant, law, noise = ready.plant, controller, 0.0
    held: Controller = law
    if loop == "ideal":
        plant = Plant(plant.robot, sensor)
    else:
        held = HeldMeasurement(controller, ready.settings.unseen)
        noise = ready.settings.noise * math.sqrt(sensor.m)
    q0, target = near_start(sensor, q_goal, distance, seed), sensor.value(q_goal)
    watch = Watch(held, sensor, target, max(noise, _SHRUNK * distance), _GROWN * distance)
    try:
        simulate(
            plant,
            watch,
            target,
            q0,
            _LONGEST,
            dt=_DT,
            record_every=1.0,
            integrator="semi_implicit_euler",
            seed=seed,
        )
    except Decided:
        pass
    except SimulationError:
        watch.verdict = "diverges"
    return watch


def near_start(sensor: Task, q_goal: Array, distance: float, seed: int) -> Array:
    """A posture whose image is about `distance` [px] from the goal's, in a seeded direction."""
    J = sensor.jacobian(q_goal, sensor.value(q_goal))
    direction = np.random.default_rng(seed).normal(size=sensor.m)
    motion = np.linalg.pinv(J) @ (distance * direction / np.linalg.norm(direction))
    return np.asarray(pin.integrate(sensor.robot.model, q_goal, motion))


class Decided(Exception):
    """Ends a simulation whose fate is decided."""


class Watch(ControllerWrapper):
    """A controller that is watched from outside, and its simulation ended once it is decided.

    It converges when the true error has been small for a second (root of the mean square), and
    diverges when it is large. Where neither happens in time, it is judged by the root of the mean
    square over the last third beside that over the middle third: a tenth less or more decides.

    Attributes:
        errors: ‖e‖, true, at every look [px].
        q: Where the arm was at the last look, shape (nq,).
        verdict: None until it is decided.

    Args:
        controller: What is watched.
        sensor: The true task.
        target: x_d, shape (n_x,).
        small: Error that counts as none [px].
        large: Error that counts as lost [px].
    """

    def __init__(
        self, controller: Controller, sensor: Task, target: Array, small: float, large: float
    ) -> None:
        self.errors: list[float] = []
        self.q = sensor.robot.neutral()
        self.verdict: Verdict | None = None
        self.controller, self._memory = controller, 0
        self._sensor, self._target = sensor, target
        self._small, self._large = small, large
        self._window = round(_LONG / (_EVERY * _DT))
        self._samples = 0

    @property
    def duration(self) -> float:
        """Time until the last look [s]."""
        return max(0, len(self.errors) - 1) * _EVERY * _DT

    @property
    def end(self) -> float:
        """RMS error over the last second, as a share of the start's."""
        last = np.array(self.errors[-self._window :])
        return float(np.sqrt((last**2).mean()) / self.errors[0])

    def initial_state(self, measurement: Measurement) -> Array:
        """That of what is watched."""
        return self.controller.initial_state(measurement)

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """What the controller answers.

        Raises:
            Decided: The fate of the run is decided.
        """
        if round(measurement.t / _DT) == self._samples:  # the first sample is evaluated twice
            if self._samples % _EVERY == 0:
                self.look(measurement.q)
            self._samples += 1
        return self.controller.step(state, measurement, target, dt)

    def look(self, q: Array) -> None:
        """Look at where the arm is; shape (nq,).

        Raises:
            Decided: The fate of the run is decided.
        """
        self.q = q.copy()
        self.see(float(np.linalg.norm(self._sensor.error(self._sensor.value(q), self._target))))

    def see(self, error: float) -> None:
        """Take note of an error [px]; NaN where the point is behind the camera.

        Raises:
            Decided: The fate of the run is decided.
        """
        self.errors.append(error)
        if not error <= self._large:
            self.verdict = "diverges"
            raise Decided
        if len(self.errors) < self._window or error > 3.0 * self._small:  # seldom worth a mean
            return
        last = np.array(self.errors[-self._window :])
        if math.sqrt((last**2).mean()) <= self._small:
            self.verdict = "converges"
            raise Decided

    def judged(self) -> Verdict:
        """The verdict, from how the error changed where the run ended before it was decided."""
        if self.verdict is not None:
            return self.verdict
        third = max(1, len(self.errors) // 3)
        squares = np.square(self.errors)
        before, after = squares[-2 * third : -third].mean(), squares[-third:].mean()
        change = math.sqrt(after / before)
        if abs(change - 1.0) <= _CHANGED:
            return "undecided"
        return "converges" if change < 1.0 else "diverges"


class Agreement(NamedTuple):
    """How often the local test and simulation say the same.

    Attributes:
        loop: "ideal" or "late".
        cells: How many were tested and simulated.
        decided: How many of them both decide.
        agreeing: How many of those alike.
        optimistic: How many the local test calls stable and simulation does not.
        pessimistic: How many the other way round.
        undecided: How many simulation leaves undecided.
        refused: How many the local test leaves undecided.
    """

    loop: Loop
    cells: int
    decided: int
    agreeing: int
    optimistic: int
    pessimistic: int
    undecided: int
    refused: int

    @property
    def share(self) -> float:
        """Share of all cells where both decide, and alike; NaN of none."""
        return self.agreeing / self.cells if self.cells else math.nan


def agreement(cells: Sequence[Cell], loop: Loop) -> Agreement:
    """Compare the local test with simulation, over the cells of one loop."""
    mine = [cell for cell in cells if cell.loop == loop]
    decided = [c for c in mine if "undecided" not in (c.predicted, c.verdict)]
    differing = [c for c in decided if c.predicted != c.verdict]
    optimistic = sum(c.predicted == "converges" for c in differing)
    return Agreement(
        loop,
        cells=len(mine),
        decided=len(decided),
        agreeing=len(decided) - len(differing),
        optimistic=optimistic,
        pessimistic=len(differing) - optimistic,
        undecided=sum(c.verdict == "undecided" for c in mine),
        refused=sum(c.singular for c in mine),
    )
