"""The errors of approxjac: one base class; each error carries the offending value.

Every message states the expected value, the given one and, where they can be listed, the
valid ones.
"""

import copyreg
import difflib
import importlib
from collections.abc import Collection, Iterable
from typing import Any

_FEW = 5  # names that are all listed


class ApproxJacError(Exception):
    """Base class of all errors that this library raises on purpose.

    Attributes:
        given: The offending value, as it was passed in.
    """

    def __init__(self, message: str, *, given: Any = None) -> None:
        super().__init__(message)
        self.given = given

    def __reduce__(self) -> tuple[Any, ...]:
        # not by calling the class, whose arguments differ: errors cross from worker processes
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class InvalidInputError(ApproxJacError, ValueError):
    """A number, array or option that is not valid."""


class UnknownNameError(ApproxJacError, LookupError):
    """A frame, joint, link or robot that does not exist, with near matches."""

    def __init__(
        self, kind: str, name: object, where: str, valid: Iterable[str], likely: str = ""
    ) -> None:
        self.valid = sorted(valid)
        message = f"{kind} {name!r} not in {where}"
        wanted = str(name).lower()
        near = sorted((n for n in self.valid if wanted and wanted in n.lower()), key=len)[:3]
        near = near or difflib.get_close_matches(str(name), self.valid, n=3, cutoff=0.5)
        if near:
            message += f"; did you mean {' or '.join(repr(n) for n in near)}?"
        elif likely:
            message += f"; {likely}"
        if self.valid and (not near or len(self.valid) <= _FEW):
            message += f"{'' if near else ';'} valid are {', '.join(self.valid)}"
        super().__init__(message, given=name)


def require_known(kind: str, name: object, where: str, valid: Collection[str]) -> None:
    """Raise an UnknownNameError unless a name is one of the valid ones."""
    if not isinstance(name, str) or name not in valid:
        raise UnknownNameError(kind, name, where, valid)


class UrdfError(ApproxJacError, ValueError):
    """A URDF that is missing, malformed or not usable for torque control."""


class ImplausibleRobotWarning(UserWarning):
    """A URDF whose masses or effort limits look like placeholders."""


class MeasurementError(ApproxJacError, ValueError):
    """A measurement without which no safe torque exists (q or v not finite)."""


class DriverError(ApproxJacError, RuntimeError):
    """A robot that refuses a command, stopped by itself or cannot be reached, in its own words."""


class ControllerError(ApproxJacError, RuntimeError):
    """A controller or limit, usually of your own, that fails in a step or returns no answer."""


class SimulationError(ApproxJacError, RuntimeError):
    """A simulation that could not be completed."""


class ControlError(ApproxJacError, RuntimeError):
    """A run on a robot that an error ended; the arm was braked, `given` is the run until then."""


class MissingPackageError(ApproxJacError, ImportError):
    """A missing optional package, which only a part of this library needs."""


class TrajectoryFileError(ApproxJacError, ValueError):
    """A file that is missing, cannot be written or does not hold a trajectory."""


def failed(what: str, t: float, error: Exception) -> ControllerError:
    """Return the error for a part that raised another one in the step at t [s]."""
    kind = "" if isinstance(error, ApproxJacError) else f"{type(error).__name__}: "
    return ControllerError(f"{what} failed at t = {t:g} s: {kind}{error}", given=error)


_NEEDED_BY = {
    "fast": "compiled code",
    "franka": "FrankaDriver",
    "lerobot": "reading parquet files",
    "mujoco": "MujocoPlant",
    "ros2": "reading MCAP files",
    "study": "drawing, judging stability or integrating in continuous time",
    "view": "showing robots or reading their meshes",
    "vision": "the search for tags in images",
}


def package_of(extra: str, name: str) -> Any:
    """Import a package that an extra installs, or raise a MissingPackageError."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"{_NEEDED_BY[extra]} needs {name.split('.')[0]}, which cannot be imported ({error}): "
            f"pip install 'approxjac[{extra}]'",
            given=name,
        ) from error
