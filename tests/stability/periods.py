"""The largest period at which something holds, and growth from frame to frame, for tests."""

import numpy as np


def radii(loop, samples, latency):
    """The spectral radii of the maps from frame to frame, of samples as targets, shape (N,)."""
    timing = latency.in_samples()
    return np.exp(timing.frame * loop.growth(samples, timing))


def largest(passes, first, halvings=7):
    """The largest time that passes, by doubling and halving from a first one on; 0 if none does."""
    low, high = 0.0, first
    while high < 64.0 * first and passes(high):
        low, high = high, 2.0 * high
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle) else (low, middle)
    return low
