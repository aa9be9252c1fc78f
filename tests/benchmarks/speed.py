"""All speed figures of the documentation, in one run of some four minutes, into docs/tables/.

    OMP_NUM_THREADS=1 python tests/benchmarks/speed.py [--out docs/tables/speed.md]

Everything is a ratio within this run, or stands beside one. Pink is measured where it is installed
(`pip install pin-pink`); its column is empty elsewhere.
"""

import argparse
import importlib.metadata
import os
import platform
from pathlib import Path

import closed_loop
import control_step
import image_step
import import_time
import memory
import step_pieces
import turns

OUT = Path(__file__).parents[2] / "docs" / "tables" / "speed.md"
PACKAGES = ("numpy", "pin", "llvmlite", "mujoco", "pin-pink")


def machine():
    """What this ran on: processor, cores, system, and what was installed."""
    found = []
    for package in PACKAGES:
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            found.append(f"no {package}")
    cores = len(os.sched_getaffinity(0))
    busy = os.getloadavg()[0]
    return (
        f"{_processor()}, {cores} cores, {platform.system()}, {busy:.1f} processes at work when it "
        f"began. Python {platform.python_version()}, {', '.join(found)}."
    )


def _processor():
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.machine()


def costs():
    """What it takes to begin: seconds, and ratios to Pinocchio's import."""
    return [(name, f"{taken:.2f}", ratio) for name, taken, ratio in import_time.rows()]


def parts():
    """Every part of the page: its name, and how to make it."""
    table = turns.table
    return {
        "machine": machine,
        "steps": lambda: table(control_step.HEADS, control_step.rows()),
        "pieces": lambda: table(step_pieces.HEADS, step_pieces.rows()),
        "images": lambda: table(image_step.HEADS, image_step.rows()),
        "loops": lambda: table(closed_loop.HEADS, closed_loop.rows()),
        "costs": lambda: table(("what", "s", "of Pinocchio's"), costs()),
        "imports": lambda: table(memory.IMPORT_HEADS, memory.import_rows()),
        "memory": lambda: table(memory.STEP_HEADS, memory.step_rows()),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="Markdown file that is written")
    out = parser.parse_args().out
    made = []
    for name, make in parts().items():
        made.append(f"<!-- {name} -->\n{make()}\n<!-- end of {name} -->\n")
        print(made[-1], flush=True)
    out.write_text("\n".join(made))


if __name__ == "__main__":
    main()
