"""Rollouts of a study whose options come in one dict, as tests share them."""

import approxjac as aj
from approxjac.stability import Execution

_OF_EXECUTION = ("engine", "executor")


def study(controller, errors, region=None, *, dt=1e-3, actuator_delay=0.0, **options):
    """The study of a loop that is sampled and late."""
    timing = aj.Latency(period=dt, torque_delay=actuator_delay)
    return aj.Study(controller, errors, region, latency=timing, **options)


def rolled(*loop, runs=100, failures=None, progress=None, **options):
    """The rollouts of a study, carried out as some of the options say."""
    execution = Execution(**{name: options.pop(name, None) for name in _OF_EXECUTION})
    told = progress if progress is None else lambda what, share: progress(round(share * runs))
    return study(*loop, **options).rollouts(
        runs, failures=failures, execution=execution, progress=told
    )
