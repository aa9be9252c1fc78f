"""What `import approxjac` costs beside `import pinocchio`: python tests/benchmarks/import_time.py.

Each import runs in a fresh interpreter; the two alternate, so that a busy machine slows both.
"""

import os
import statistics
import subprocess
import sys
import time

ROUNDS = 15


def seconds(module: str) -> float:
    """Wall time of a fresh interpreter that imports one module [s]."""
    # Byte code is cached for both, as it is on a user's machine.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", f"import {module}"], check=True, env=environment)
    return time.perf_counter() - start


def measured() -> tuple[float, float, float]:
    """The median of the ratios, and those of both times [s]."""
    for module in ("pinocchio", "approxjac"):
        seconds(module)  # warm the disk cache and the byte code
    pairs = [(seconds("pinocchio"), seconds("approxjac")) for _ in range(ROUNDS)]
    ratio = statistics.median(ours / theirs for theirs, ours in pairs)
    theirs, ours = (statistics.median(column) for column in zip(*pairs, strict=True))
    return ratio, theirs, ours


def main() -> None:
    """Print them."""
    ratio, theirs, ours = measured()
    print(
        f"import approxjac / import pinocchio = {ratio:.2f} "
        f"({1e3 * ours:.0f} ms / {1e3 * theirs:.0f} ms, medians of {ROUNDS})"
    )


if __name__ == "__main__":
    main()
