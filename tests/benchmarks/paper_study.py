"""How long `approxjac paper` takes: python tests/benchmarks/paper_study.py.

Wall time of the whole command in a fresh interpreter, pictures included, beside that of importing
the libraries it stands on, so that a busy or slow machine shows in both.
"""

import statistics
import subprocess
import sys
import tempfile
import time

ROUNDS = 3
LIBRARIES = "pinocchio, scipy.integrate, matplotlib.figure"


def seconds(*arguments: str) -> float:
    """Wall time of one Python process [s]."""
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def main() -> None:
    """Print the medians."""
    with tempfile.TemporaryDirectory() as out:
        pairs = [
            (
                seconds("-c", f"import {LIBRARIES}"),
                seconds("-m", "approxjac", "paper", "--out", out),
            )
            for _ in range(ROUNDS)
        ]
    libraries, study = (statistics.median(column) for column in zip(*pairs, strict=True))
    print(
        f"approxjac paper takes {study:.1f} s, {study / libraries:.1f} times as long as importing "
        f"{LIBRARIES} ({libraries:.2f} s); medians of {ROUNDS}"
    )


if __name__ == "__main__":
    main()
