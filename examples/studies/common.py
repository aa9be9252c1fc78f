"""Parts that the studies share: processes, tables, results, and the object that an arm holds."""

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import cache
from pathlib import Path

from tqdm import tqdm

import approxjac as aj

LENGTH, MASS = 0.20, 0.5
LARGEST_SHARE = 0.15  # of the arm's moving mass that an object may have


def parser(description, out):
    """Return a parser with the options that all studies have."""
    options = argparse.ArgumentParser(description=description.splitlines()[0])
    options.add_argument("--out", type=Path, default=Path(out), help="folder for the results")
    options.add_argument("--jobs", type=int, help="processes; as many as processors by default")
    options.add_argument("--quick", action="store_true", help="run a small part of the study")
    return options


def run_all(run_case, cases, jobs=None):
    """Run cases in several processes and return their outcomes in the order of the cases.

    Args:
        run_case: A function that other processes can import.
        cases: Its arguments.
        jobs: Number of processes; as many as there are processors by default.
    """
    with ProcessPoolExecutor(jobs) as pool:
        waiting = [pool.submit(run_case, case) for case in cases]
        # tqdm shows nothing where the output is not a terminal (disable=None)
        for _ in tqdm(as_completed(waiting), total=len(cases), unit="case", disable=None):
            pass
        return [future.result() for future in waiting]


def row(*cells):
    """Return a row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*cells):
    """Return the first two lines of a Markdown table."""
    return [row(*cells), f"|{'---|' * len(cells)}"]


def two_digits(value):
    """Return a number with two digits, as people write it: 710, not 7.1e+02."""
    text = f"{value:.2g}"
    return text if abs(value) < 99.5 else f"{float(text):.0f}"


def write(out, tables, summary):
    """Write and print the tables by name, and write summary.json.

    Args:
        out: Folder.
        tables: Text of each table, by the name of its file.
        summary: Contents of summary.json.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, text in tables.items():
        (out / name).write_text(text, encoding="utf-8")
        print(text)
    text = json.dumps(plain(summary), indent=2, allow_nan=False)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    print(f"{', '.join(tables)} and summary.json are in {out}")


def plain(value):
    """Return a value as JSON can hold it: JSON knows neither NaN nor infinity."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@cache
def carried_object(robot):
    """Return length [m] and mass [kg] of the object that an arm of this name holds.

    20 cm and 0.5 kg; for arms that this would be more than 15 % of the moving mass of, 15 % of it
    and the length of a body of the same shape.
    """
    share = MASS / (LARGEST_SHARE * aj.load_robot(robot).mass)
    if share <= 1.0:
        return LENGTH, MASS
    return round(LENGTH / share ** (1.0 / 3.0), 3), round(MASS / share, 3)


def plain_law(built, settling_time):
    """Return a scenario with the law of the paper, which a study is about, and no joint stops.

    Gains for a settling time [s] at the loop's lags, and s(e) = e, in place of the rule's.
    """
    law, scenario = built.law, built.scenario
    dt, sensor = scenario.loop.dt, scenario.sensor
    lag = dt + (sensor.velocity_filter or 0.0) + scenario.loop.actuator_delay
    if law.velocity is not None:  # Ẋ of law (5) is as late as x
        lag += law.velocity.time_constant + sensor.delay
        lag += 0.0 if sensor.rate is None else 0.5 / sensor.rate
    gains = aj.default_gains(law.task, settling_time, 1.0 / lag)
    chosen = aj.SetpointController(law.task, gains, gravity=law.gravity, velocity=law.velocity)
    controller, unseen = chosen, scenario.controller.unseen
    if built.limits is not None:
        controller = aj.TorqueLimited(chosen, built.limits, dt=dt)
    if unseen is not None:
        controller = aj.HeldMeasurement(controller, unseen)
    plant = built.plant._rebuilt(joint_limits=False)
    return replace(built, plant=plant, law=chosen, controller=controller)
