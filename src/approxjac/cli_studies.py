"""The commands that run a whole study: arguments → a study → files and a summary."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from approxjac.cli.output import Live, make_folder
from approxjac.errors import InvalidInputError
from approxjac.studies.servo_settings import ServoSettings
from approxjac.studies.stability import StabilitySettings

_NOT_LIVE = Live()
_SHARE = "{desc}: {percentage:3.0f} %|{bar}| {elapsed}"


def arms(
    robots: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = (),
    starts: int = 20,
    duration: float = 30.0,
    jobs: int | None = None,
    out: Path = Path("results/arms"),
) -> int:
    """Let every arm reach targets with a tool that its controller believes absent.

    Example: approxjac arms --robots panda ur5 --starts 5

    Exit code 0 if at least 95 % of the runs with known gravity converge, 1 if not.

    Args:
        robots: Arms to try; all that load by name by default.
        starts: Seeded starts and targets for each arm, with gravity known and with gravity learnt.
        duration: Of each run, in s.
        jobs: Processes that share the work; as many as there are processors by default.
        out: Folder for table.md and summary.json.
    """
    from approxjac.studies import arms as study

    cases = study.cases(robots, starts, duration)
    make_folder(out)
    with tqdm(total=len(cases), unit="run", disable=None) as bar:
        outcomes = study.run(cases, jobs, progress=lambda: bar.update() and None)
    (out / "table.md").write_text(study.table(outcomes), encoding="utf-8")
    summary = study.summary(outcomes)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(study.table(outcomes))
    print(f"table.md and summary.json are in {out}")
    return 0 if summary["verdict"] == "ok" else 1


def limiters(
    robots: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = (),
    scales: tuple[float, ...] = (),
    starts: int = 15,
    duration: float = 10.0,
    jobs: int | None = None,
    out: Path = Path("results/limiters"),
) -> int:
    """Compare limiters of the torque on the same reaches, with ever weaker motors.

    Exit code 1 means that the QP broke a torque limit or what it says of the proof, or that with
    the weakest motors fewer runs converged within the joints' limits than with clipping.

    Args:
        robots: Arms to try; panda, xarm7 and two_link by default.
        scales: Shares of the effort limits; 1, 0.7, 0.5, 0.35 and 0.25 by default.
        starts: Seeded starts and targets for each arm and scale.
        duration: Of each run, in s.
        jobs: Processes that share the work; as many as there are processors by default.
        out: Folder for table.md, limiters.png, limiters.svg and summary.json.
    """
    from approxjac.studies import limiters as study
    from approxjac.studies import limiters_report as report
    from approxjac.view import save_figure

    cases = study.cases(robots, scales, starts, duration)
    make_folder(out)
    with tqdm(total=len(cases), unit="start", disable=None) as bar:
        outcomes = study.run(cases, jobs, progress=lambda: bar.update() and None)
    table, summary = report.table(outcomes), report.summary(outcomes)
    (out / "table.md").write_text(table, encoding="utf-8")
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    save_figure(report.draw(outcomes), out / "limiters")
    print(table)
    print("\n".join(f"fell short: {text}" for text in summary["shortcomings"]) or "all kept")
    print(f"\ntable.md, the picture and summary.json are in {out}")
    return 0 if summary["verdict"] == "ok" else 1


def servo_study(
    starts: int = 100,
    comparisons: int = 8,
    map_goals: int = 3,
    limits: bool = False,
    jobs: int | None = None,
    out: Path = Path("results/servo-study"),
) -> int:
    """Servo a Panda with a badly wrong camera from many starts; compare laws; map tolerated roll.

    Exit code 1 means that fewer than 95 % of the starts whose path stays in view converged to
    within the noise.

    Args:
        starts: Seeded starts whose path stays in view.
        comparisons: Seeded starts from which each law runs with each noise; 0 compares nothing.
        map_goals: Seeded goals of the map of tolerated roll; 0 makes no map.
        limits: Let the starts, not the comparisons, keep the URDF's limits of torques, speeds and
            joints, which the controller does not know otherwise.
        jobs: Processes that share the work; as many as there are processors by default.
        out: Folder for table.md, noise and map as .png and .svg, and summary.json.
    """
    from approxjac.studies import servo_map, servo_study_report, servo_study_view
    from approxjac.studies import servo_study as study
    from approxjac.view import save_figure

    starts = study.require_starts(starts)
    compared, cells = study.cases(comparisons), servo_map.cases(map_goals)
    make_folder(out)
    with tqdm(total=starts + len(compared) + len(cells), unit="run", disable=None) as bar:

        def advance() -> None:
            bar.update()

        result = servo_study_report.Result(
            starts,
            study.must_show(
                starts, jobs, advance, study.WITHIN_LIMITS if limits else study.ONE_POINT
            ),
            study.compare(compared, jobs, advance),
            servo_map.run(cells, jobs, advance),
        )
    table, summary = servo_study_report.table(result), servo_study_report.summary(result)
    (out / "table.md").write_text(table, encoding="utf-8")
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if result.compared:
        save_figure(servo_study_view.draw_noise(result.compared), out / "noise")
    if result.cells:
        save_figure(servo_study_view.draw_map(result.cells), out / "map")
    print(table)
    print("\n".join(f"fell short: {text}" for text in summary["shortcomings"]) or "all shown")
    print(f"\ntable.md, the pictures and summary.json are in {out}")
    return 0 if summary["verdict"] == "ok" else 1


def servo(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[ServoSettings, tyro.conf.OmitArgPrefixes],
    live: Annotated[Live, tyro.conf.OmitArgPrefixes] = _NOT_LIVE,
    out: Path = Path("results/servo"),
) -> int:
    """Let an arm bring points to where they shall be in the image of a camera nobody calibrated.

    Example: approxjac servo panda --roll 0.5 --focal-factor 1.3

    Exit code 0 if the image error ended within the tolerance, 1 if not.

    Args:
        robot: Name of an arm, a .urdf file, or a .toml file that names the robot and holds any of
            these options, such as roll = 0.5; options given here come before it.
        settings: What to simulate.
        live: How to see it while it goes on.
        out: Folder for run, image and views as .png and .svg, run.npz and summary.json.
    """
    from approxjac.studies import servo as study
    from approxjac.studies import servo_report as report

    prepared = study.prepare(robot, settings)
    make_folder(out)
    observer = live.observer(prepared.believe, settings.believed_length)
    with _bar(settings.duration, live) as progress:
        result = study.run(prepared, progress, observer)
    report.write(result, out)
    print(report.text(result))
    print(_written(out))
    return 0 if result.converged else 1


def stability(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[StabilitySettings, tyro.conf.OmitArgPrefixes],
    jobs: int = 1,
    out: Path = Path("results/stability"),
) -> int:
    """Tell whether a controller is stable before anything moves, by how much, and what to change.

    Example: approxjac stability panda --object-length 0 0.3 --around 0 -0.5 0 -2 0 1.6 0.7

    Exit code 0 if Theorem 1 or the matrix form certifies the region, 1 if not.

    Args:
        robot: Name of an arm, or a .urdf file.
        settings: What to look at.
        jobs: Processes that share the rollouts.
        out: Folder for figure1, workspace and map as .png and .svg, and summary.json.
    """
    from concurrent.futures import ProcessPoolExecutor
    from contextlib import nullcontext

    from approxjac.studies import stability as study
    from approxjac.studies import stability_report as report

    if jobs < 1:
        raise InvalidInputError(f"jobs must be >= 1, got {jobs}", given=jobs)
    case = study.prepare(robot, settings)
    make_folder(out)
    pool = ProcessPoolExecutor(jobs) if jobs > 1 else nullcontext()
    with pool as executor, tqdm(total=1.0, disable=None, bar_format=_SHARE) as bar:

        def tell(what: str, share: float) -> None:
            bar.set_description(what, refresh=False)
            bar.update(share - bar.n)

        result = study.run(
            case, executor, tell, lambda found: bar.write(report.verdicts(case, found))
        )
    report.write(result, out)
    print(report.consequences(result))
    print(f"\nPictures and summary.json are in {out}")
    return 0 if result.report.certified_by is not None else 1


@contextmanager
def _bar(duration: float, live: Live) -> Iterator[Callable[[float], None]]:
    """A progress bar over the time of a run, none where the run is shown; yields what moves it."""
    # tqdm shows nothing where the output is not a terminal (disable=None)
    with tqdm(total=duration, unit="s", disable=True if live.view else None) as bar:
        yield lambda t: bar.update(t - bar.n) and None


def _written(out: Path) -> str:
    return (
        f"\nPictures, the run and summary.json are in {out}\n"
        f"See it move: approxjac view {out / 'run.npz'}"
    )
