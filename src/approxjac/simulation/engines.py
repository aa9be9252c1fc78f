"""What carries a run out: Python, step by step, or machine code, all steps at once.

`codegen` builds on plants and loops, and knows how to make code of them; so it is found by name,
when a run is long enough for it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.simulation.trajectory import Trajectory

ENGINES = ("compiled", "python")
_MACHINE_CODE = "approxjac.codegen.whole_run"


def require_engine(engine: str | None, reason: str) -> None:
    """Refuse an engine that is none, and machine code where there is a reason against it.

    Raises:
        UnknownNameError: No such engine.
        InvalidInputError: It is "compiled", and there is a reason.
    """
    if engine is not None and engine not in ENGINES:
        raise UnknownNameError("engine", engine, "simulate", ENGINES)
    if engine == "compiled" and reason:
        raise InvalidInputError(
            f'engine must be "python" or None for {reason}, got {engine!r}', given=engine
        )


def run_in_code(
    loop: SampledLoop, stride: int, engine: str | None, progress: Callable[[float], None] | None
) -> tuple[Trajectory | None, str]:
    """Return a run that machine code carried out, or None, and why it did not.

    Args:
        loop: At the beginning.
        stride: Which steps are recorded: each so many, and the last.
        engine: "compiled" makes code of a short run, too; with None it has to be worth it.
        progress: Called now and then with the time reached [s].

    Raises:
        InvalidInputError: "compiled" is asked for, and code cannot be made.
        MissingPackageError: "compiled" is asked for, and llvmlite is not installed.
    """
    run, why = importlib.import_module(_MACHINE_CODE).whole_run(
        loop, stride, progress, must=engine == "compiled"
    )
    return run, why
