"""Memory: what an import takes, and what control steps allocate and leave behind.

python tests/benchmarks/memory.py
"""

import gc
import subprocess
import sys
import tracemalloc
from itertools import cycle, islice
from pathlib import Path

import control_step
import turns

STEPS = 100_000
STATUS = "/proc/self/status"


def import_peak(module):
    """The most memory [MB] that a fresh interpreter has had when it has imported a module."""
    code = f"{f'import {module}' if module else ''}\nprint(open({STATUS!r}).read())"
    answer = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    return kilobytes("VmHWM", answer.stdout) / 1024


def allocated(step, inputs):
    """The most bytes that one step has allocated at a time, its answer included."""
    tracemalloc.start()
    try:
        most = 0
        for values in inputs:
            before, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            step(*values)
            most = max(most, tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    return most


def left_behind(step, inputs, steps):
    """Bytes that are still allocated after as many steps."""
    for values in inputs:
        step(*values)
    tracemalloc.start()
    try:
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        for values in islice(cycle(inputs), steps):
            step(*values)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return after - before


def kilobytes(name, status):
    """An entry of what Linux tells of a process [kB]."""
    (line,) = (line for line in status.splitlines() if line.startswith(name))
    return int(line.split()[1])


def grown(step, inputs, steps=STEPS):
    """By how much this process has grown after as many steps [kB]."""
    for values in islice(cycle(inputs), steps // 20):
        step(*values)
    before = kilobytes("VmRSS", Path(STATUS).read_text())
    for values in islice(cycle(inputs), steps):
        step(*values)
    return kilobytes("VmRSS", Path(STATUS).read_text()) - before


def import_rows():
    """What is imported, and the memory of the interpreter then [MB]."""
    return [(f"`{name}`" if name else "nothing", import_peak(name)) for name in IMPORTS]


IMPORTS = ("", "numpy", "pinocchio", "approxjac")


def step_rows():
    """Bytes of a step, and growth over many, of the laws on a Panda."""
    _, _, inputs = control_step.arm("panda")
    found = []
    for law in control_step.laws("panda"):
        step = law.ours
        found.append((law.name, allocated(step, inputs), float(grown(step, inputs))))
    return found


IMPORT_HEADS = ("imported", "peak memory, MB")
STEP_HEADS = ("law on a Panda", "bytes in a step", f"growth over {STEPS} steps, kB")


def main():
    print(turns.table(IMPORT_HEADS, import_rows()), end="\n\n")
    print(turns.table(STEP_HEADS, step_rows()))


if __name__ == "__main__":
    main()
