"""Studies of many cases, shared out among processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from approxjac.errors import InvalidInputError

Case = TypeVar("Case")
Outcome = TypeVar("Outcome")


def run_in_processes(
    run_case: Callable[[Case], Outcome],
    cases: Sequence[Case],
    jobs: int | None = None,
    progress: Callable[[], None] | None = None,
) -> list[Outcome]:
    """Run cases in several processes, and return their outcomes in the order of the cases.

    Args:
        run_case: What runs one case; a function that other processes can import.
        cases: The cases.
        jobs: Processes; as many as there are processors by default.
        progress: Called after each case.

    Raises:
        InvalidInputError: Less than one process.
    """
    if jobs is not None and jobs < 1:
        raise InvalidInputError(f"jobs must be at least 1, got {jobs}", given=jobs)
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [pool.submit(run_case, case) for case in cases]
        for _ in as_completed(waiting):
            if progress is not None:
                progress()
        return [future.result() for future in waiting]
