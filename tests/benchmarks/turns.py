"""The one way in which these benchmarks measure steps: all take turns, in one process."""

import time
import types

import numpy as np

WARMING = 100  # inputs


def medians(steps, inputs, rounds):
    """Median over rounds of each step's processor time [s], of a dictionary of steps.

    In a round every step goes through all inputs, one step after the other, so that a slow moment
    of the machine hits all of them; what other processes take away is not counted. Before its time
    is taken a step has brought its code back into the caches, whatever went before it.
    """
    steps = {name: _of_its_own(step) for name, step in steps.items()}
    times = {name: np.empty(rounds) for name in steps}
    for i in range(rounds):
        for name, step in steps.items():
            for values in inputs[:WARMING]:
                step(*values)
            start = time.process_time()
            for values in inputs:
                step(*values)
            times[name][i] = (time.process_time() - start) / len(inputs)
    return {name: float(np.median(each)) for name, each in times.items()}


def _of_its_own(step):
    """The same function with byte code of its own.

    Python adapts byte code to what it calls. In a program that has one controller it does so once;
    here, steps that were made by the same `def` would undo it for each other at every turn.
    """
    if not isinstance(step, types.FunctionType):
        return step
    code = step.__code__.replace(co_name=step.__name__)
    copy = types.FunctionType(
        code, step.__globals__, step.__name__, step.__defaults__, step.__closure__
    )
    copy.__kwdefaults__ = step.__kwdefaults__
    return copy


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
