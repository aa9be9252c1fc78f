"""The one way in which these benchmarks measure steps: all take turns, in one process."""

import time

import numpy as np


def medians(steps, inputs, rounds):
    """Median over rounds of each step's processor time [s], of a dictionary of steps.

    In a round every step goes through all inputs, one step after the other, so that a slow moment
    of the machine hits all of them; what other processes take away is not counted.
    """
    times = {name: np.empty(rounds) for name in steps}
    for step in steps.values():
        step(*inputs[0])
    for i in range(rounds):
        for name, step in steps.items():
            start = time.process_time()
            for values in inputs:
                step(*values)
            times[name][i] = (time.process_time() - start) / len(inputs)
    return {name: float(np.median(each)) for name, each in times.items()}


def table(heads, rows):
    """Markdown, with numbers to three digits; "–" where there is nothing to compare with."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(map(_shown, row)) + " |" for row in rows])


def _shown(cell):
    if cell is None:
        return "–"
    if isinstance(cell, str):
        return cell
    digits = 0 if cell >= 100 else 1 if cell >= 10 else 2
    return f"{cell:.{digits}f}"
