"""`RolloutSetting`: the common setting of rollouts, and how they run, one by one or in lanes."""

import importlib.util
import math
import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.lanes import OUTCOME, Lanes, LaneStart
from approxjac.codegen.loop_program import loop_key
from approxjac.controllers import SetpointController
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, SimulationError, package_of, require_known
from approxjac.simulation import Computation, Plant, Sensing, Trajectory, simulate
from approxjac.simulation.simulate import Wanted, target_at, whole, x_of
from approxjac.stability.errors.region import Region
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.configurations import UnattainedError, VisiblePart
from approxjac.validation import Array

_RECORDS = 500  # of a run: 50 in its last tenth
_PER_STEP = 6e-5  # s, of a step of a run in Python
_LONG = 60.0  # s, which is said before
_EXAMPLES = 16  # runs that show what differs from run to run
_ENGINES = ("lanes", "python")
_COMPILED = 4  # loops that a process keeps


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """One run.

    Attributes:
        index: k, from 0. Seed and index determine all random draws.
        values: True values of the uncertain coordinates, shape (d,).
        q0: Start, at rest, shape (nq,).
        target: x_d at the beginning, shape (n_x,).
        final_error: ‖e‖ at the end [unit of the task]; infinite if the run diverged, or ended
            behind the camera, where there is no image.
        settling_time: First recorded time from which on ‖e‖ is below the accuracy at every
            recorded instant [s]; NaN if it is not at the end.
        peak_torque: Largest commanded torque at a recorded instant, as a share of its motor's
            limit; NaN if the run diverged.
        peak_speed: Largest joint speed, likewise, as a share of its limit; NaN if it diverged.
        converged: True if ‖e‖ is below it at every recorded instant of the last tenth.
        diverged: True if the simulation could not be completed.
        stayed: True if all recorded configurations are in the region; False if the run diverged.
    """

    index: int
    values: Array
    q0: Array
    target: Array
    final_error: float
    settling_time: float
    peak_torque: float
    peak_speed: float
    converged: bool
    diverged: bool
    stayed: bool

    def __repr__(self) -> str:
        became = "diverged" if self.diverged else f"ended {self.final_error:.3g} off"
        settled = f", converged after {self.settling_time:.3g} s" if self.converged else ""
        return f"Rollout({self.index}: {became}{settled})"


COLUMNS = tuple(field.name for field in fields(Rollout))


@dataclass(frozen=True, eq=False)
class Start:
    """Begin of a run, as of `Rollout`: truth, start and target."""

    index: int
    values: Array
    plant: Plant
    q: Array
    target: Array
    seed: int  # of noise and dropouts

    def lane_start(
        self, controller: Controller, frames: tuple[str, ...] | None = None
    ) -> LaneStart:
        """Return the numbers that lanes keep of it, whose sensor looks at some frames."""
        return LaneStart.of(controller, self.plant, self.q, self.target, self.seed, frames)


@dataclass(frozen=True, eq=False)
class RolloutSetting:
    """The common setting of all runs.

    Attributes:
        controller: The controller.
        uncertainty: Set of true robots to draw from.
        region: Region of starts and targets.
        target: x_d of all, shape (n_x,), or a moving target; None draws them.
        duration: Duration of each run [s].
        dt: Sampling time [s].
        accuracy: Error below which a task counts as done [unit of the task].
        seed: Seed of all random draws.
        sensing: Sensor errors, or None.
        actuator_delay: Time from a torque command to its effect [s].
        engine: "lanes" or "python".
        reason: Reason for Python; "" for lanes, or if Python was requested.
        key: Key of the compiled loop.
        alike: Controllers and errors of settings that share the compiled loop, which differ in
            every number that may differ between them.
    """

    controller: Controller
    uncertainty: Uncertainty
    region: Region
    target: Wanted | None
    duration: float
    dt: float
    accuracy: float
    seed: int
    sensing: Sensing | None = None
    actuator_delay: float = 0.0
    engine: str = "python"
    reason: str = ""
    key: bytes = b""
    alike: tuple[tuple[Controller, Uncertainty], ...] = ()

    @property
    def steps(self) -> int:
        """Number of steps of a run."""
        return whole("dt", self.dt, self.duration)

    @property
    def every(self) -> int:
        """Number of steps from one recorded instant to the next."""
        return max(1, round(self.duration / self.dt / _RECORDS))

    def start(self, index: int) -> Start:
        """Draw the start of a run, from a generator of its own."""
        rng = np.random.default_rng([self.seed, index])
        values = self.uncertainty.sample(rng)
        plant = self.uncertainty.plant(values)._sensed(self.sensing, self.actuator_delay)
        seen = VisiblePart(self.region, plant.sensor)
        try:
            q0 = plant.robot.configuration(self.region.sample(1, rng)[0], "q0")
            q0 = seen.replace_unseen(q0[None], rng)[0]
            if self.target is None:
                target = plant.sensor.value(seen.sample(1, rng)[0])
            else:
                target = x_of(target_at(self.target, 0.0))
        except UnattainedError as error:
            message = f"{error}, with {self.uncertainty.describe(values)}"
            raise UnattainedError(message, given=values, truth=index) from error
        return Start(index, values, plant, q0, target, int(rng.integers(2**63)))

    def simulated(self, start: Start) -> Trajectory:
        """Return a run in Python."""
        target = start.target if self.target is None else self.target
        return simulate(
            start.plant, self.controller, target, start.q, self.duration, dt=self.dt,
            record_every=self.every * self.dt, seed=start.seed,
            computation=Computation("semi_implicit_euler"),
        )  # fmt: skip

    def _outcome(self, start: Start) -> tuple[float, ...]:
        """Return the `OUTCOME` of a run in Python."""
        try:
            record = self.simulated(start)
        except SimulationError:
            return -1.0, math.inf, math.nan, math.nan, 1.0, 1.0, 0.0
        bad = np.flatnonzero(~(record.error_norm < self.accuracy)).max(initial=-1)
        return (
            -1.0 if bad < 0 else min(bad * self.every, self.steps),
            float(record.error_norm[-1]),
            float(np.abs(record.tau / start.plant.motor_limits).max()),
            float(np.abs(record.v / start.plant.robot.velocity_limits).max()),
            not all(map(self.region.contains, record.q)),
            0.0,
            0.0,
        )

    def columns(self, indices: range, drawn: Sequence[Start] | None = None) -> dict[str, Array]:
        """Return some runs, as columns; in lanes if they are its engine.

        Their starts may be given, as `drawn` for another setting with the same errors.
        """
        lanes = _lanes_of(self) if self.engine == "lanes" else None
        starts, ran = [], list[Any]()
        for start in map(self.start, indices) if drawn is None else drawn:
            starts.append((start.index, start.values, start.q, start.target))
            begun = None if lanes is None else start.lane_start(self.controller, lanes.frames)
            ran.append(begun or self._outcome(start))
        last = lanes.run(ran, self.every) if lanes else dict(zip(OUTCOME, np.array(ran).T))  # noqa: B905
        for k in np.flatnonzero(last["left"]):  # those that lanes leave are runs in Python
            for name, value in zip(OUTCOME, self._outcome(self.start(indices[k])), strict=True):
                last[name][k] = value
        diverged, last_bad = last["diverged"] > 0.0, last["last_bad"]
        settled = (last_bad < self.steps) & ~diverged
        after = np.where(last_bad < 0.0, 0.0, (last_bad // self.every + 1) * self.every)
        after = np.minimum(after, self.steps)  # the last instant is recorded, too
        columns: dict[str, Any] = dict(zip(COLUMNS, map(np.array, zip(*starts, strict=True))))  # noqa: B905
        return columns | {
            "final_error": np.where(diverged | np.isnan(last["error"]), math.inf, last["error"]),
            "settling_time": np.where(settled, after * self.dt, math.nan),
            "peak_torque": np.where(diverged, math.nan, last["torque"]),
            "peak_speed": np.where(diverged, math.nan, last["speed"]),
            "converged": settled & (last_bad < np.ceil((0.9 - 1e-9) * self.steps)),
            "diverged": diverged,
            "stayed": (last["outside"] == 0.0) & ~diverged,
        }


def with_engine(
    settings: Sequence[RolloutSetting], engine: str | None, runs: int
) -> list[RolloutSetting]:
    """Return settings with the requested engine, or the fastest that covers them.

    Args:
        settings: Settings that differ in gains or scale at most, so that what covers the first
            covers all.
        engine: "lanes", "python" or None.
        runs: Number of runs of each.
    """
    if engine is not None:
        require_known("engine", engine, "rollouts", _ENGINES)
    if engine == "python" or not settings:
        return [*settings]
    in_lanes = _sharing([replace(each, engine="lanes") for each in settings])
    try:
        _lanes_of(in_lanes[0])
    except InvalidInputError as error:
        if engine is not None:
            raise
        return [replace(each, reason=str(error)) for each in settings]
    if engine is not None:
        package_of("fast", "llvmlite")
    elif importlib.util.find_spec("llvmlite") is None:
        runs *= len(settings)
        seconds = _PER_STEP * in_lanes[0].steps * runs
        if seconds > _LONG:
            warnings.warn(
                f"{runs} runs of {in_lanes[0].duration:g} s take Python about {seconds / 60.0:.0f} "
                f"min of one core, and machine code some {max(seconds / 300.0, 1.0):.0f} s: "
                "pip install 'approxjac[fast]'",
                stacklevel=3,
            )
        return [replace(each, reason="llvmlite is not installed") for each in settings]
    return in_lanes


def _sharing(settings: list[RolloutSetting]) -> list[RolloutSetting]:
    """Return settings that differ in scale alone, or in gains that all grow, with one loop.

    In code, gains are numbers like others; but limits and postures follow from them.
    """
    groups: dict[int, list[int]] = {}
    for k, each in enumerate(settings):
        law = each.controller
        gains_are_numbers = type(law) is SetpointController and law.posture is None
        groups.setdefault(0 if gains_are_numbers else id(law), []).append(k)
    shared = settings.copy()
    for group in groups.values():
        ends = dict.fromkeys((settings[group[0]], settings[group[-1]]))
        errors = max((settings[k].uncertainty for k in group), key=lambda each: each.factor)
        laws = dict.fromkeys(each.controller for each in ends)
        alike = tuple((law, errors) for law in laws)
        key = loop_key(*ends)
        for k in group:
            shared[k] = replace(shared[k], key=key, alike=alike)
    return shared


_lanes: dict[bytes, Lanes] = {}
_compiling = threading.Lock()


def _lanes_of(setting: RolloutSetting) -> Lanes:
    """Return the loop of a setting, made once in each process, or refuse it."""
    with _compiling:
        if setting.key not in _lanes:
            if not setting.uncertainty.makes_the_robots:
                kind = type(setting.uncertainty).__name__
                raise InvalidInputError(
                    "uncertainty must be one whose plant and robot are those of Uncertainty for "
                    f"lanes, got {kind}: {setting.uncertainty!r}",
                    given=setting.uncertainty,
                )
            while len(_lanes) >= _COMPILED:
                del _lanes[next(iter(_lanes))]
            examples = []
            for law, errors in setting.alike:
                one = replace(setting, controller=law, uncertainty=errors)
                starts = [one.start(index) for index in range(_EXAMPLES)]
                frames = tasks.frames(errors.nominal.sensor)
                examples += [each.lane_start(law, frames) for each in starts]
            _lanes[setting.key] = Lanes(
                law, starts[0].plant, examples, setting.region, setting.dt, setting.steps,
                setting.accuracy,
                path=None if isinstance(setting.target, np.ndarray) else setting.target,
            )  # fmt: skip
        return _lanes[setting.key]
