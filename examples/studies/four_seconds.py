"""Run `approxjac simulate` for 4 s on ten arms that hold a tool of 10 cm and 0.1 kg, unknown to it.

    python examples/studies/four_seconds.py --out results/four_seconds

Exit code 1 means that a final error was above 2 mm, or that a law asked for more than the motors'
torque. docs/studies/reaching.md has what came out.
"""

import json
import subprocess
import sys
from typing import NamedTuple

from common import head, parser, row, run_all, two_digits, write
from reaches import ARMS

OPTIONS = "--object-length 0.1 --object-mass 0.1 --believed-length 0 --duration 4"
WANTED = 2e-3  # [m]


class Case(NamedTuple):
    """One call."""

    robot: str
    options: tuple[str, ...]
    out: str


class Outcome(NamedTuple):
    """What its summary.json says."""

    robot: str
    start_error: float  # [m]
    final_error: float  # [m]
    torque: float  # largest, as a share of what its motor delivers
    speed: float  # largest, as a share of its limit
    reason: str


def run_case(case):
    """Call the command once and read what it wrote."""
    command = [sys.executable, "-m", "approxjac", "simulate", case.robot, *case.options]
    done = subprocess.run([*command, "--out", case.out], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise RuntimeError(done.stderr)
    with open(f"{case.out}/summary.json", encoding="utf-8") as file:
        said = json.load(file)
    speed = (said["limits"] or {}).get("peak_speed_ratio", float("nan"))
    return Outcome(
        case.robot, said["start_error_m"], said["final_error_m"], said["peak_torque_ratio"], speed,
        said["reason"],
    )  # fmt: skip


def main(arguments=None):
    """Call the command for each arm; return the exit code."""
    options = parser(__doc__, "results/four_seconds")
    options.add_argument("--arms", nargs="+", default=ARMS)
    options.add_argument("--seeds", nargs="+", type=int, default=[0], help="of the target")
    options.add_argument("--options", default=OPTIONS, help="of approxjac simulate")
    given = options.parse_args(arguments)
    cases = [
        Case(robot, (*given.options.split(), "--seed", str(seed)), f"{given.out}/{robot}_{seed}")
        for robot in (given.arms[:2] if given.quick else given.arms)
        for seed in given.seeds
    ]
    outcomes = run_all(run_case, cases, given.jobs)
    lines = head("arm", "error at 0 s", "at the end", "torque, share of the motors", "speed")
    for o in outcomes:
        errors = f"{1e3 * o.start_error:.0f} mm", f"{two_digits(1e3 * o.final_error)} mm"
        lines.append(row(o.robot, *errors, f"{o.torque:.2f}", f"{o.speed:.2f}"))
    if ended := [f"- {o.robot}: {o.reason}" for o in outcomes if o.reason]:
        lines += ["", *ended]
    write(given.out, {"four_seconds.md": "\n".join(lines) + "\n"}, {"runs": outcomes})
    failed = [o.robot for o in outcomes if o.final_error > WANTED or o.torque > 1.0 + 1e-9]
    print(f"fell short: {', '.join(failed)}" if failed else "all kept")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
