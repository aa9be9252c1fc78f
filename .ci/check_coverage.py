#!/usr/bin/env python3
"""Branch coverage of the last tests, folder by folder; fails below what was promised.

Run after tests under pytest-cov, with the Python that has coverage. It judges all folders, or
those that it is given: `python .ci/check_coverage.py law`.
"""

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

LEAST = {"law": 95.0, "stability": 95.0, "controllers": 95.0, "all of src": 90.0}  # %

with tempfile.TemporaryDirectory() as scratch:
    report = Path(scratch, "coverage.json")
    subprocess.run([sys.executable, "-m", "coverage", "json", "-q", "-o", report], check=True)
    files = json.loads(report.read_text())["files"]

KEYS = ("covered_branches", "num_branches", "covered_lines", "num_statements")
counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
for name, file in files.items():
    inside = Path(name).as_posix().partition("approxjac/")[2].split("/")
    for folder in (inside[0] if len(inside) > 1 else "(top)", "all of src"):
        for i, key in enumerate(KEYS):
            counts[folder][i] += file["summary"][key]


def percent(part: int, whole: int) -> float:
    """Share in percent; of nothing it is all."""
    return 100.0 * part / whole if whole else 100.0


judged = sys.argv[1:] or list(LEAST)
short = [f"{folder}: not measured at all" for folder in judged if folder not in counts]
print(f"{'folder':12s} {'branches':>9s} {'taken':>8s} {'statements':>11s} {'run':>8s}")
for folder in sorted(counts, key=lambda folder: (folder == "all of src", folder)):
    taken, branches, run, statements = counts[folder]
    share = percent(taken, branches)
    shares = f"{branches:9d} {share:7.1f}% {statements:11d} {percent(run, statements):7.1f}%"
    print(f"{folder:12s} {shares}")
    if folder in judged and share < LEAST[folder]:
        short.append(f"{folder}: {share:.2f} % of branches taken, {LEAST[folder]:g} % asked")
sys.exit("\n".join(short) or 0)
