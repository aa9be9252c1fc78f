"""The largest period at which something holds, for tests."""


def largest(passes, first, halvings=7):
    """The largest time that passes, by doubling and halving from a first one on; 0 if none does."""
    low, high = 0.0, first
    while high < 64.0 * first and passes(high):
        low, high = high, 2.0 * high
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle) else (low, middle)
    return low
