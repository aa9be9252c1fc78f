"""A built scenario run: simulated, recorded and judged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from approxjac.scenario.build import BuiltScenario, sampling_time
from approxjac.scenario.image_result import ImageResult
from approxjac.scenario.result import Result
from approxjac.scenario.tally import Tally
from approxjac.simulation import SampledLoop, Trajectory, simulate

_RECORDS = 2000  # of a sampled run, about
_CONTINUOUS_RECORDS = 2400


def result_of(
    built: BuiltScenario,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[SampledLoop], None] | None = None,
) -> Result:
    """Simulate a scenario and judge it, as `BuiltScenario.run` does."""
    tally = None
    if built.limits is not None:
        tally = observer = Tally(np.asarray(built.limits.effort), observer)
    kind = ImageResult if "px" in built.plant.sensor.units else Result
    return kind(built, record(built, progress, observer), tally)


def record(
    built: BuiltScenario,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[SampledLoop], None] | None = None,
) -> Trajectory:
    """Simulate a scenario for its duration; `progress` and `observer` are those of `simulate`.

    Raises:
        SimulationError: The closed loop diverged.
    """
    run, dt = built.scenario.run, sampling_time(built.scenario)
    if dt == 0.0:
        return simulate(
            built.plant, built.controller, built.target, built.q0, run.duration, dt=None,
            record_every=run.duration / _CONTINUOUS_RECORDS, progress=progress, observer=observer,
        )  # fmt: skip
    every = max(1, round(run.duration / (dt * _RECORDS)))
    return simulate(
        built.plant,
        built.controller,
        built.target,
        built.q0,
        max(1, round(run.duration / (dt * every))) * dt * every,
        dt=dt,
        record_every=every * dt,
        integrator="semi_implicit_euler",
        seed=run.seed,
        progress=progress,
        observer=observer,
    )
