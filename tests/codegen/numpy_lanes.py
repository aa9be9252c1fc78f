"""A `Program` that NumPy carries out: the reference for `LlvmLanes`, operation by operation."""

from itertools import chain

import numpy as np

from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.program import STEP, Block


class NumpyLanes:
    """A program that NumPy carries out, all runs at once."""

    width = 1

    def __init__(self, program):
        self._program = program
        self._function = numpy_function(program.graph, [*chain(*program.stepped.values())])

    def run(self, kept, parameters, block=None):
        """Take steps, in place: see `LlvmLanes.run`."""
        first, times, draws = block or Block.plain()
        state, given = (np.moveaxis(a, 1, 0).reshape(a.shape[1], -1) for a in (kept, parameters))
        state = state.copy()
        groups, steps, n_draws, width = draws.shape
        drawn = np.moveaxis(draws, 0, 2).reshape(steps, n_draws, groups * width)
        for k, (now, own) in enumerate(zip(times, drawn, strict=True), first):
            self._step(state, given, now, own, k)
        kept[...] = np.moveaxis(state.reshape(len(state), len(kept), -1), 0, 1)

    def _step(self, state, given, now, own, k):
        program = self._program
        known = (program.rows, state), (program.parameters, given), (program.draws, own)
        values = {STEP: [np.float64(k)]}
        for places, array in (*known, (program.times, now)):
            values |= {name: array[at : at + size] for name, (at, size) in places.items()}
        goes_to = program.rows.copy()
        for name, (start, size) in program.histories.items():
            at, to = (start + size * int(values[f"{name}.{way}"][0]) for way in ("from", "to"))
            values[name], goes_to[name] = state[at : at + size], (to, size)
        computed = iter(self._function(**values))
        rows = {name: [next(computed) for _ in each] for name, each in program.stepped.items()}
        after = {
            name: [np.array(np.broadcast_to(row, state.shape[1:])) for row in each]
            for name, each in rows.items()
        }
        for name, each in after.items():
            at, size = goes_to[name]
            if size:
                state[at : at + size] = each
