"""What it costs to begin: imports, and the first controller, in fresh interpreters.

    python tests/benchmarks/import_time.py

The programs take turns, so that a busy machine slows all of them.
"""

import os
import statistics
import subprocess
import sys
import time

ROUNDS = 15
BUILD = (
    "import approxjac as aj; law = aj.SetpointController(aj.PositionTask(aj.load_robot('panda')))"
)
PROGRAMS = {
    "`import pinocchio`": "import pinocchio",
    "`import approxjac`": "import approxjac",
    "with a first `SetpointController`": BUILD,
    "and that compiled": BUILD + "; aj.codegen.compiled(law)",
}


def seconds(program: str) -> float:
    """Wall time of a fresh interpreter that runs a program [s]."""
    # Byte code is cached for all, as it is on a user's machine.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)
    return time.perf_counter() - start


def rows() -> list[tuple[str, float, float]]:
    """Each program: its name, the median of its time [s], and of its ratio to the first one."""
    for program in PROGRAMS.values():
        seconds(program)  # warm the disk cache and the byte code
    times = [[seconds(program) for program in PROGRAMS.values()] for _ in range(ROUNDS)]
    found = []
    for i, name in enumerate(PROGRAMS):
        ratios = [each[i] / each[0] for each in times]
        found.append((name, statistics.median(e[i] for e in times), statistics.median(ratios)))
    return found


def main() -> None:
    """Print them."""
    for name, time_taken, ratio in rows():
        print(f"{name.replace('`', '')}: {time_taken:.2f} s, {ratio:.2f} of import pinocchio")


if __name__ == "__main__":
    main()
