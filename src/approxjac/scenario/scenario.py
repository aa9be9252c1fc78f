"""`Scenario`: one description of robot, belief, task, sensor, controller and run."""

from __future__ import annotations

import tomllib
from dataclasses import KW_ONLY, dataclass, fields
from pathlib import Path
from types import SimpleNamespace

from approxjac.errors import InvalidInputError
from approxjac.files import read_text, write_text
from approxjac.scenario import records
from approxjac.scenario.convert import Table, checked, differences, filled, to_toml

_MOST_TEXT = 1_000_000  # bytes of a file
_ANY = records.Object(float("nan"), float("nan"))  # which equals no other: files say what is held
_UNSAID = {"true": records.Truth(object=_ANY), "believed": records.Belief(object=_ANY)}


@dataclass(frozen=True)
class Scenario:
    """One description for simulation, stability report, export and live view.

    `build_scenario` makes plant and controller of it, `run_scenario` simulates them. Each part may
    be a record, or a table of the values that differ from the defaults:
    `Scenario("panda", true={"object": {"length": 0.3}}, run={"target": {"offset": (0.1, 0, 0)}})`.
    It prints as an equivalent scenario file.

    Attributes:
        robot: Name of an arm, or a .urdf file.
        tip: End-effector frame that holds the object; the robot's own by default.
        base: Link that the chain to the tip starts from.
        free: Joints off the chain to the tip that are not locked.
        true: The truth, which only the plant gets to see.
        believed: The belief of the controller.
        task: The task, measured and controlled.
        sensor: Errors of measurements.
        controller: The law, its gains, and its limits.
        loop: Period and delay of control.
        run: Start, target, duration.
        stability: Errors and region of a stability report.

    Raises:
        UnknownNameError: An unknown key.
        InvalidInputError: A value of another type, or out of range.
    """

    robot: str
    _: KW_ONLY
    tip: str | None = None
    base: str | None = None
    free: tuple[str, ...] = ()
    true: records.Truth = records.Truth()
    believed: records.Belief = records.Belief()
    task: records.TaskChoice = records.TaskChoice()
    sensor: records.Sensor = records.Sensor()
    controller: records.ControllerChoice = records.ControllerChoice()
    loop: records.LoopRecord = records.LoopRecord()
    run: records.Run = records.Run()
    stability: records.Analysis = records.Analysis()

    def __post_init__(self) -> None:
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        vars(self).update(checked(Scenario, Scenario, given))  # frozen once it is built

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Return the scenario that a TOML file describes.

        Raises:
            InvalidInputError: No such file, no TOML, no robot, or an invalid value.
            UnknownNameError: An unknown key.
        """
        try:
            table = tomllib.loads(read_text(Path(path), _MOST_TEXT))
        except FileNotFoundError as error:
            raise InvalidInputError(f"{path} does not exist", given=path) from error
        except (OSError, ValueError, RecursionError) as error:  # lists in lists, long numbers
            message = f"{path} cannot be read as TOML: {error}"
            raise InvalidInputError(message, given=path) from error
        robot = table.get("robot")
        if not isinstance(robot, str):
            message = f'{path} must name a robot, such as robot = "panda", got {robot!r}'
            raise InvalidInputError(message, given=path)
        scenario = cls(robot).with_values(table, str(path))
        file = Path(path).resolve().parent / (scenario.true.calibration or "")
        beside = {"true": {"calibration": file.as_posix()}} if file.is_file() else {}
        return scenario.with_values(beside)

    def with_values(self, table: Table, where: str = "") -> Scenario:
        """Return this scenario with the values of a table, such as `{"run": {"duration": 5.0}}`.

        Errors name `where` the table is from; they are those of `Scenario`.
        """
        return filled(self, table, where)

    def save(self, path: str | Path) -> Path:
        """Write an equivalent scenario file, and return its path."""
        write_text(Path(path), str(self))
        return Path(path)

    def __str__(self) -> str:
        usual = vars(Scenario(self.robot)) | _UNSAID
        return to_toml({"robot": self.robot, **differences(self, SimpleNamespace(**usual))})
