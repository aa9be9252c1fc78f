"""The commands that run a whole study: arguments → a study → files and a summary."""

from __future__ import annotations

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
