"""This tree against another one, such as an older commit: the same work in turns, least CPU time.

git worktree add /tmp/before 1e9b642
python tests/benchmarks/before.py /tmp/before
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import turns

HERE = Path(__file__).parents[2]
ROUNDS = 5

SETUP = """
import numpy as np, time
import approxjac as aj
arm = aj.load_robot("panda")
plant = aj.Plant(arm.with_object(0.2, 0.5, axis="x"))
belief = arm.with_object(0.0)
task = aj.PositionTask(belief)
q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
x_d = plant.sensor.value(q0) + [0.10, -0.15, 0.16]
"""
RUN = """
law = aj.SetpointController(task{gravity})
options = {{"record_every": 1.0}} if {sparse} else {{}}
aj.simulate(plant, law, x_d, q0, 1.0, **options)  # warm
start = time.process_time()
aj.simulate(plant, law, x_d, q0, 1.0, **options)
print(time.process_time() - start)
"""
LEARNT = ", gravity=aj.AdaptiveGravity(belief)"
PROBES = {
    "`simulate`, 1000 steps, each recorded": SETUP + RUN.format(gravity="", sparse=False),
    "the same, two recorded": SETUP + RUN.format(gravity="", sparse=True),
    "`simulate`, gravity learnt, each recorded": SETUP + RUN.format(gravity=LEARNT, sparse=False),
    "the same, two recorded ": SETUP + RUN.format(gravity=LEARNT, sparse=True),
    "`import approxjac`": """
import time
start = time.process_time()
import approxjac
print(time.process_time() - start)
""",
    "a first controller, after the import": """
import time
import approxjac as aj
start = time.process_time()
aj.SetpointController(aj.PositionTask(aj.load_robot("panda")))
print(time.process_time() - start)
""",
    "`approxjac --help`": """
import contextlib, io, time
start = time.process_time()
from approxjac.cli import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(["--help"])
print(time.process_time() - start)
""",
    "drawing a true robot, 100 times": SETUP
    + """
errors = aj.Uncertainty(arm, object_length=(0.0, 0.3), object_mass=(0.0, 1.0),
                        joint_shifts={"panda_joint4": (0.0, 0.01, 0.0)})
rng = np.random.default_rng(0)
errors.plant(errors.sample(rng))
start = time.process_time()
for _ in range(100):
    errors.plant(errors.sample(rng))
print(time.process_time() - start)
""",
}


def seconds(tree: Path, probe: str) -> float:
    """Return the CPU time that a probe measured of itself, in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "OMP_NUM_THREADS": "1"}
    said = subprocess.run(
        [sys.executable, "-c", probe], env=environment, check=True, capture_output=True, text=True
    )
    return float(said.stdout.split()[-1])


def main() -> None:
    """Print a table: ms before and now, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path, help="folder of the other tree")
    before = parser.parse_args().before
    rows = []
    for name, probe in PROBES.items():
        pairs = [(seconds(before, probe), seconds(HERE, probe)) for _ in range(ROUNDS)]
        old, new = (1e3 * min(times) for times in zip(*pairs, strict=True))
        rows.append((name, old, new, old / new))
    print(turns.table(("", "before [ms]", "now [ms]", "before / now"), rows))


if __name__ == "__main__":
    main()
