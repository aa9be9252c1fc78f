"""The least that a controller of one's own is, for tests to derive from."""

import approxjac as aj


class OwnController(aj.Controller):
    """A controller of a task without a state; derive from it to write `evaluate`."""
