"""`approxjac learn`: recordings of an arm → its URDF as it is."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from approxjac.calibration import Calibration, Recording, calibrate
from approxjac.cli.options import make_folder
from approxjac.errors import InvalidInputError, MissingPackageError
from approxjac.files import refusing
from approxjac.robots import load_robot


def learn(
    robot: str,
    files: tuple[str, ...] = (),
    kind: Literal["socket", "point", "pose"] | None = None,
    apart: float | None = None,
    unknown: tuple[str, ...] = ("tool", "origins", "axes"),
    tip: str | None = None,
    base: str | None = None,
    out: Path = Path("results/learn"),
) -> int:
    """Calibrate an arm from recordings: tool, joint origins, axes and encoders.

    Example: approxjac learn panda front/*.csv left/*.csv --apart 0.05 --out panda_6

    Exit code 0 if the arm is known better than by its drawing where it was not fitted; 1 if not, or
    if something else is wrong, too; 2 for files that cannot be read.

    Args:
        robot: Name or path of the arm as it is drawn.
        files: csv files with joint names in the first row, and x y z, qx qy qz qw, socket or place,
            torques name.tau and time t; without a first row of names, joints only, in the arm's
            order. Also .mcap, LeRobot's .parquet and run.npz.
        kind: What was measured, if it is less than the columns say; "socket" is a tip held at one
            place.
        apart: Distance of the two sockets of each place, m.
        unknown: What may be wrong: tool, origins, axes.
        tip: The frame that was held or seen.
        base: Link that the chain to the tip starts from.
        out: Folder for arm.urdf, report.txt, .json and .html, residuals.csv, calibration.npz and
            scenario.toml.
    """
    if not files:
        raise InvalidInputError("learn needs files after the robot, got none", given=files)
    arm = load_robot(robot, tip=tip, base=base)
    recordings = [_taken_as(Recording.load(path), kind) for path in files]
    found = calibrate(arm, recordings, unknown, apart=_pairs(recordings, apart))
    make_folder(out)
    _write(found, out)
    print(found)
    print(f"\nThe arm is in {out / 'arm.urdf'}; its tip is {found.robot.tip}")
    try:
        from approxjac.view import save_calibration_page

        page = save_calibration_page(found, out / "report.html")
        print(f"See where it is known, and how well: {page}")
    except MissingPackageError as error:
        print(f"No report.html: {error}")
    print(f"Try it: approxjac simulate {out / 'scenario.toml'}, or approxjac stability")
    return 0 if found.is_explained and found.is_better and not np.isnan(found.held_out) else 1


def _taken_as(recording: Recording, kind: str | None) -> Recording:
    kinds = ("socket", "motion", "point", "pose")
    if kind is None or kind == recording.kind or (recording.kind == "motion" and kind != "socket"):
        return recording
    if kinds.index(kind) > kinds.index(recording.kind):
        message = f"kind must be one that the files have, {recording.kind} at most, got {kind}"
        raise InvalidInputError(message, given=kind)
    if kind == "socket":
        return replace(recording, quaternion=None, x=None, tau=None)
    return replace(recording, quaternion=None)


def _pairs(
    recordings: Sequence[Recording], apart: float | None
) -> dict[tuple[str, str], float] | None:
    if apart is None:
        return None
    sockets: dict[str, list[str]] = {}
    for each in recordings:
        for socket, place in zip(each.socket, each.place, strict=True):
            if each.kind == "socket" and socket not in sockets.setdefault(place, []):
                sockets[place].append(socket)
    pairs = {place: names for place, names in sockets.items() if len(names) == 2}
    if not pairs:
        counts = ", ".join(f"{place} has {len(names)}" for place, names in sockets.items())
        message = f"apart needs two sockets at a place, {counts or 'there are none'}"
        raise InvalidInputError(message, given=apart)
    return {(f"{place} {a}", f"{place} {b}"): apart for place, (a, b) in pairs.items()}


def _write(found: Calibration, out: Path) -> None:
    path = found.robot.save_urdf(out / "arm.urdf")
    true, mass = "", 0.0
    if (fit := found.dynamics) is not None:
        viscous, coulomb = np.mean(fit.friction.viscous), np.mean(fit.friction.coulomb)
        true = f"friction = {viscous:.4g}  # the mean of the joints\ncoulomb = {coulomb:.4g}\n"
        mass = max(fit.payload, 0.0)
    true += f"object = {{length = 0.0, mass = {mass:.4g}}}\n"
    texts = {
        "report.txt": f"{found}\n",
        "report.json": json.dumps(found.summary(), indent=2) + "\n",
        "scenario.toml": f'robot = "{path.resolve().as_posix()}"\ntip = "{found.robot.tip}"\n'
        + f'\n[true]\ncalibration = "calibration.npz"\n{true}',
        "residuals.csv": "row,left [m]\n"
        + "".join(f"{row},{left:.6g}\n" for row, left in found.residuals.items()),
    }
    for name, text in texts.items():
        with refusing("--out must be a folder that can be written to", out / name):
            (out / name).write_text(text, encoding="utf-8")
    found.save(out / "calibration.npz")
