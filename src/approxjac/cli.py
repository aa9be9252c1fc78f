"""The command `approxjac`: arguments → a study → files and a summary.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tqdm import tqdm

import approxjac
from approxjac.cli_studies import arms, limiters, make_folder, paper, servo_study
from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.studies.reach import Settings
from approxjac.studies.servo_settings import ServoSettings
from approxjac.studies.settings_file import with_file
from approxjac.studies.stability import StabilitySettings

if TYPE_CHECKING:
    from approxjac.view.browser.live import LiveView

_FROM_FILE = {"simulate": Settings, "servo": ServoSettings}  # commands that take a .toml file
_SHARE = "{desc}: {percentage:3.0f} %|{bar}| {elapsed}"
_DESCRIPTION = (
    "Torque control of any URDF arm whose kinematics are not exactly known. "
    "COMMAND --help says more of each command, with examples; --version prints the version; "
    "exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
)


@dataclass(frozen=True)
class Live:
    """How to see a run while it goes on.

    Attributes:
        view: Show it in the browser while it goes on; there, and here by typing, the target and the
            believed length can be changed, and the run paused or stopped.
        speed: Of the run with --view, as a multiple of real time; 1 by default.
        port: Of the page with --view, on this machine; 7007 by default, or any free one.
    """

    view: tyro.conf.FlagCreatePairsOff[bool] = False
    speed: float | None = None
    port: int | None = None

    def observer(self, believe: Any, believed_length: float) -> LiveView | None:
        """What `simulate` is to show its steps to, if anything."""
        if not self.view:
            for name, value in (("speed", self.speed), ("port", self.port)):
                if value is not None:
                    raise InvalidInputError(
                        f"--{name} is for a run that is shown with --view, got {value:g} without",
                        given=value,
                    )
            return None
        from approxjac.view import LiveView

        return LiveView(
            speed=1.0 if self.speed is None else self.speed,
            port=self.port,
            believe=believe,
            believed_length=believed_length,
            terminal=True,
        )


_NOT_LIVE = Live()


def robots(
    robot: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME|FILE")] = None,
    tip: str | None = None,
    base: str | None = None,
    free: tuple[str, ...] = (),
) -> int:
    """List the arms that load by name, or describe one by name or from a .urdf file.

    Example: approxjac robots panda

    Args:
        robot: Name or path of the one to describe.
        tip: Its end-effector frame; joints that do not move it are locked.
        base: Link that the chain to the tip starts from.
        free: Joints that are not locked although the tip does not need them, or "all".
    """
    from approxjac.studies import robots_report as report

    if robot is not None:
        print(report.details(robot, tip=tip, base=base, free=free))
    elif tip is None and base is None and not free:
        print(report.table())
    else:
        raise InvalidInputError("--tip, --base and --free need a robot, got none", given=None)
    return 0


def simulate(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes],
    live: Annotated[Live, tyro.conf.OmitArgPrefixes] = _NOT_LIVE,
    out: Path = Path("results/simulate"),
) -> int:
    """Let an arm reach a target although its controller believes a wrong robot.

    Example: approxjac simulate panda --object-length 0.2 --believed-length 0 --seed 1

    Exit code 0 if the error ended within the tolerance, 1 if not.

    Args:
        robot: Name of an arm, a .urdf file, or a .toml file that names the robot and holds any of
            these options, such as object_length = 0.3; options given here come before it.
        settings: What to simulate.
        live: How to see it while it goes on.
        out: Folder for run.png, run.svg, run.npz and summary.json.
    """
    from approxjac.studies import reach
    from approxjac.studies import reach_report as report

    prepared = reach.prepare(robot, settings)
    make_folder(out)
    observer = live.observer(prepared.believe, settings.believed_length)
    with _bar(settings.duration, live) as progress:
        result = reach.run(prepared, progress, observer)
    report.write(result, out)
    print(report.text(result))
    print(_written(out))
    return 0 if result.converged else 1


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


def view(
    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")],
    out: Path | None = None,
    title: str | None = None,
) -> int:
    """Make a page of a run, to see in a browser and to keep: one file that needs no network.

    Example: approxjac view results/simulate --out page.html

    Args:
        run: A run.npz that simulate, servo, paper or Trajectory.save wrote, or a folder with one.
        out: The page, such as page.html; beside the run by default, and then it is opened too.
        title: Of the page; by default what the run is of.
    """
    from approxjac.simulation import Trajectory
    from approxjac.view import save_page
    from approxjac.view.browser.opening import open_browser

    path = _run_file(run)
    beside = path.with_name(path.name.removesuffix(".npz") + ".html")
    page = save_page(Trajectory.load(path), out or beside, title)
    print(page)
    if out is None and not open_browser(page.resolve().as_uri()):
        print("No browser could be opened here: open it in yours")
    return 0


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


def _run_file(run: Path) -> Path:
    """The file of a run, where its folder may have been given."""
    if not run.is_dir():
        if run.is_file() and run.suffix.lower() != ".npz":
            raise InvalidInputError(
                f"RUN must be a run.npz that simulate, servo, paper or Trajectory.save wrote, or a "
                f"folder with one, got {run}",
                given=run,
            )
        return run
    found = sorted(run.glob("*.npz"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise InvalidInputError(
            f"RUN must be a file, or a folder with one run (.npz), got {run} with {names}",
            given=run,
        )
    return found[0]


_COMMANDS: dict[str, Callable[..., int]] = {
    "paper": paper,
    "robots": robots,
    "simulate": simulate,
    "servo": servo,
    "view": view,
    "stability": stability,
    "arms": arms,
    "limiters": limiters,
    "servo-study": servo_study,
}


def _app(chosen: str) -> tyro.extras.SubcommandApp:
    """All commands: each with one line in the list of them, and with all its text where chosen."""
    app = tyro.extras.SubcommandApp()
    for name, command in _COMMANDS.items():
        line = str(command.__doc__).split("\n")[0]
        app.command(name=name, help=None if name == chosen else line)(command)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"approxjac {approxjac.__version__}")
        return 0
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show λ shows "?"
    try:
        if arguments and not arguments[0].startswith("-") and arguments[0] not in _COMMANDS:
            raise UnknownNameError("command", arguments[0], "approxjac", _COMMANDS)
        arguments = with_file(arguments, _FROM_FILE)
        app = _app(arguments[0] if arguments else "")
        return _flushed(int(app.cli(args=arguments, prog="approxjac", description=_DESCRIPTION)))
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads on, and what was not done yet is not done
        return _flushed(128 + 13)  # as what SIGPIPE ends
    except (ApproxJacError, OSError) as error:  # a full disk, a file that is a folder, …
        print(f"approxjac: {error}", file=sys.stderr)
        return 2


def _flushed(code: int) -> int:
    """Return the exit code when all is printed that somebody still reads, as `head` may not."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or it fails at exit again
    return code
