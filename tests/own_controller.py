"""The least that a controller of one's own is, for tests to derive from."""

from approxjac.controllers import ContinuousController


class OwnController(ContinuousController):
    """A controller of a task without a state; derive from it to write `evaluate`."""

    def __init__(self, task):
        self._task = task

    @property
    def task(self):
        return self._task
