"""`TracedSensing`: real sensors and late motors of a run, on symbols and step by step."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from approxjac.codegen.trace.program import RECORDED, Program
from approxjac.codegen.trace.symbols import Symbols, select, symbols
from approxjac.interface import Measurement, Target, TargetPath
from approxjac.robots.traced import motion_between
from approxjac.simulation import Plant, Sensing
from approxjac.simulation.sensing import (
    SensorFrames,
    encoded,
    filtered,
    generator,
    imaged,
    lost_entries,
)
from approxjac.simulation.simulate import target_at
from approxjac.validation import Array

_IMAGE, _TORQUE = "image", "late_torque"


class TracedSensing:
    """Sensors and motors of all runs of a plant: noise, rounding, lateness, dropouts.

    As in `SensorReadings` and `MovingArm`. Which frame arrives depends on time only and is the same
    in all runs; random numbers are drawn beforehand, from the generators of each run.

    Runs have so many steps of dt [s]; `path` is that of the target of all, or None.
    """

    late: int  # by how many steps torques are late
    may_lose: bool  # x may be lost on its way

    def __init__(
        self, plant: Plant, dt: float, steps: int, path: Target | TargetPath | None
    ) -> None:
        self._sensor, self._dt = plant.sensor, dt
        self._times: dict[str, Any] = {}  # name → what is the same in all runs, step by step
        self._targets: list[Target] = []
        if path is not None:
            targets = (target_at(path, k * dt) for k in range(steps + 1))
            self._targets = [each for each in targets if isinstance(each, Target)]
        sensing = self._sensing = plant.sensing or Sensing()
        sizes = sensing.sizes(plant.sensor)
        self._x_noise, self._x_quantum, self._q_noise, self._q_quantum = sizes
        self._lost = lost_entries(sensing, plant.sensor)
        self.may_lose = sensing.x_dropout > 0.0 or bool(self._lost)
        self.late = round(min(plant.actuator_delay / dt, float(steps)))
        self._k, self._always = np.arange(steps + 1), np.ones(steps + 1, dtype=bool)
        frames = SensorFrames(sensing, dt)
        each = (frames.next(k * dt) for k in range(steps + 1))
        taken, kept_at, self._lost_in, read_at, new, self._t_x = zip(*each, strict=True)
        self._is_taken, self._is_new = np.array(taken), np.array(new)
        self._kept_at, self._read_at = np.array(kept_at), np.array(read_at)
        self._is_now = self._is_taken & (self._kept_at == self._read_at)

    def measured(self, program: Program, truth: Measurement) -> tuple[Measurement, dict[str, Any]]:
        """Return the measurement of the truth, and the numbers to keep."""
        t, q, v, x, _ = truth
        sensing, sensor = self._sensing, self._sensor
        kept: dict[str, Any] = {}

        def noise(name: str, size: Array) -> Symbols | None:
            return size * program.drawn(name, len(size)) if size.any() else None

        q = encoded(sensor.robot, q, noise("q_noise", self._q_noise), self._q_quantum)
        if sensing.velocity_filter is not None:
            before, v = program.kept("q_before", len(q)), program.kept("v_filtered", len(v))
            motion = motion_between(sensor.robot, before, q)
            slope = np.where(symbols(program.k > 0.0), motion, 0.0) / self._dt
            v = filtered(v, slope, sensing.velocity_filter, self._dt)
            kept |= {"q_before": q, "v_filtered": v}
        x = imaged(sensor, x, noise("x_noise", self._x_noise), self._x_quantum)
        if self._lost:
            lost = np.zeros((len(self._k), len(x)))
            for row, intervals in zip(lost, self._lost_in, strict=True):
                for interval in intervals:
                    row[self._lost[interval]] = 1.0
            x = np.where(self._timed(program, "lost", lost) > 0.0, np.nan, x)
        if not self._is_now.all():
            kept[_IMAGE], unread = x, int(self._kept_at.max()) + 1
            image = program.history(_IMAGE, len(x), unread + 1)
            goes_to = np.where(self._is_taken, self._kept_at, unread)
            self._times |= {f"{_IMAGE}.from": self._read_at, f"{_IMAGE}.to": goes_to}
            x = np.where(self._timed(program, "now", self._is_now) > 0.0, x, image)
        if sensing.x_dropout > 0.0:
            drops = program.drawn("x_dropout", 1)[0] < sensing.x_dropout
            before = program.kept("dropped", 1)[0]
            is_new = self._timed(program, "new", self._is_new)[0] > 0.0
            kept["dropped"] = select(is_new, select(drops, 1.0, 0.0), before)
            x = np.where(symbols(kept["dropped"] > 0.0), np.nan, x)
        return Measurement(t, q, v, x, self._timed(program, "t_x", self._t_x)[0]), kept

    def _timed(self, program: Program, name: str, values: Any) -> Symbols:
        self._times[name] = values
        return program.timed(name, int(np.size(values)) // len(self._k))

    def target(self, program: Program) -> Target | None:
        """Return the target of this step if all runs have the same path, else None."""
        if not self._targets:
            return None
        x_d, v_d = self._timed(program, "target", [each.x for each in self._targets]), None
        if any(each.v is not None for each in self._targets):
            at_rest = np.zeros(self._sensor.m)
            rates = [at_rest if each.v is None else each.v for each in self._targets]
            v_d = self._timed(program, "target_v", rates)
        return Target(x_d, v_d)

    def acting(self, program: Program, torque: Symbols) -> tuple[Symbols, dict[str, Any]]:
        """Return the torque that acts when one is commanded, and the commands to keep."""
        if not self.late:
            return torque, {}
        self._times |= dict.fromkeys((f"{_TORQUE}.from", f"{_TORQUE}.to"), self._k % self.late)
        return program.history(_TORQUE, len(torque), self.late), {_TORQUE: torque}

    def start(self, program: Program, kept: Array, holding: Array) -> None:
        """Set the kept numbers (N, rows) before the first step, with holding torques (N, n_v)."""
        if self.late:
            at, size = program.histories[_TORQUE]
            kept[:, at : at + size * self.late] = np.tile(holding, self.late)

    def times(self, program: Program, every: int) -> Array:
        """Return the numbers of each step that all runs share, shape (steps, times).

        Each so many steps, and the last, are recorded.
        """
        is_due = (self._k % every == 0) | (self._k == self._k[-1])
        known = self._times | {RECORDED: is_due}
        rows = np.zeros((len(self._k), program.n_times))
        for name, (at, size) in program.times.items():
            rows[:, at : at + size] = np.reshape(known[name], (-1, size))
        return rows

    def drawn(
        self, program: Program, seeds: Sequence[int], width: int
    ) -> Callable[[int, int], Array]:
        """Return a function that draws for the runs of some seeds, as vectors of a width.

        Of the next steps, from one number to another, it returns what `Block.draws` has.
        """
        drawn_at = {"x_noise": self._is_taken, "x_dropout": self._is_new}
        draws = {}
        for name in program.draws:
            kind = "random" if name == "x_dropout" else "standard_normal"
            draws[name] = [getattr(generator(seed, name), kind) for seed in seeds]

        def block(first: int, end: int) -> Array:
            values = np.zeros((-(-len(seeds) // width), end - first, program.n_draws, width))
            for name, (at, size) in program.draws.items():
                here = drawn_at.get(name, self._always)[first:end]
                number = int(here.sum())
                steps: Any = slice(None) if number == len(here) else np.flatnonzero(here)
                for lane, draw in enumerate(draws[name]):
                    group, i = divmod(lane, width)
                    values[group, :, at : at + size, i][steps] = draw((number, size))
            return values

        return block
