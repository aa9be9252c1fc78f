"""The command `approxjac`: arguments → a study → files and a summary.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import io
import json
import math
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

import approxjac
from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.studies.reach import Settings
from approxjac.studies.servo_settings import ServoSettings
from approxjac.studies.settings_file import with_file
from approxjac.studies.stability import StabilitySettings

app = tyro.extras.SubcommandApp()
_FROM_FILE = {"simulate": Settings, "servo": ServoSettings}  # commands that take a .toml file
_SHARE = "{desc}: {percentage:3.0f} %|{bar}| {elapsed}"
_DESCRIPTION = (
    "Torque control of any URDF arm whose kinematics are not exactly known. "
    "--version prints the version."
)


@app.command(name="paper")
def paper(
    out: Path = Path("results/paper"),
    figures: tuple[int, ...] = (1, 3, 4, 5, 6, 7, 8),
    start: Annotated[tuple[float, float], tyro.conf.arg(metavar="DEG DEG")] = (60.0, 90.0),
    target: Annotated[tuple[float, float], tyro.conf.arg(metavar="DEG DEG")] = (90.0, 90.0),
    friction: float = 0.0,
    gamma: float | None = None,
    inertia: Literal["rod", "point-mass"] = "rod",
    duration: float = 120.0,
) -> int:
    """Reproduce the paper's two-link study, Figures 1 and 3-8, with a verdict for each.

    Args:
        out: Folder for figN.png, figN.svg, figN.npz and summary.json.
        figures: Figures to make, such as "--figures 3 4".
        start: Posture q(0) at the start, in degrees.
        target: Posture whose image is the target, in degrees.
        friction: Viscous friction B at both joints, N m s/rad.
        gamma: Saturation of the error on the sensor, in m; "None" is s(e) = e.
        inertia: Uniform rods, or point masses at their middles.
        duration: Length of each run, in s.
    """
    from approxjac.studies import paper as study
    from approxjac.studies import paper_report as report
    from approxjac.view import save_figure

    known = [1, *study.EXPERIMENTS]
    if not figures:
        raise InvalidInputError("figures must name at least one figure, got none", given=figures)
    for figure in figures:
        if figure not in known:
            raise InvalidInputError(
                f"figures must be among {', '.join(map(str, known))}, got {figure}", given=figure
            )
    setup = study.Setup(
        start=(math.radians(start[0]), math.radians(start[1])),
        target=(math.radians(target[0]), math.radians(target[1])),
        friction=friction,
        gamma=gamma,
        inertia=inertia,
        duration=duration,
    )
    _make_folder(out)
    truth = study.build_arm(inertia=inertia)
    bound = None
    results = []
    experiments = [study.EXPERIMENTS[f] for f in sorted(set(figures)) if f != 1]
    # tqdm shows nothing where the output is not a terminal (disable=None)
    with tqdm(total=max(1, len(experiments)) * duration, unit="s", disable=None) as bar:
        if 1 in figures:
            bar.set_description("figure 1")
            bound = study.jacobian_bound(setup)
            save_figure(report.draw_bound(bound), out / "fig1")
        for i, experiment in enumerate(experiments):
            bar.set_description(f"figure {experiment.figure}")

            def advance(t: float, done: float = i * duration) -> None:
                bar.update(done + t - bar.n)

            result = study.run_experiment(experiment, setup, progress=advance)
            report.write_result(result, setup, truth, out)
            results.append(result)
    summary = report.summary(results, bound, setup)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(report.table(results, bound))
    print(f"\nPictures, runs and summary.json are in {out}")
    return 0 if all(result.agrees_with_paper for result in results) else 1


@app.command(name="robots")
def robots(
    robot: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME|FILE")] = None,
    tip: str | None = None,
    base: str | None = None,
    free: tuple[str, ...] = (),
) -> int:
    """List the arms that load by name, or describe one by name or from a .urdf file.

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


@app.command(name="simulate")
def simulate(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[Settings, tyro.conf.OmitArgPrefixes],
    out: Path = Path("results/simulate"),
) -> int:
    """Let an arm reach a target although its controller believes a wrong robot.

    Args:
        robot: Name of an arm, a .urdf file, or a .toml file that names the robot and holds any of
            these options, such as object_length = 0.3; options given here come before it.
        settings: What to simulate.
        out: Folder for run.png, run.svg, run.npz and summary.json.
    """
    from approxjac.studies import reach
    from approxjac.studies import reach_report as report

    prepared = reach.prepare(robot, settings)
    _make_folder(out)
    with tqdm(total=settings.duration, unit="s", disable=None) as bar:
        result = reach.run(prepared, progress=lambda t: bar.update(t - bar.n) and None)
    report.write(result, out)
    print(report.text(result))
    print(f"\nPictures, the run and summary.json are in {out}")
    return 0 if result.converged else 1


@app.command(name="servo")
def servo(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[ServoSettings, tyro.conf.OmitArgPrefixes],
    out: Path = Path("results/servo"),
) -> int:
    """Let an arm bring points to where they shall be in the image of a camera nobody calibrated.

    Args:
        robot: Name of an arm, a .urdf file, or a .toml file that names the robot and holds any of
            these options, such as roll = 0.5; options given here come before it.
        settings: What to simulate.
        out: Folder for run, image and views as .png and .svg, run.npz and summary.json.
    """
    from approxjac.studies import servo as study
    from approxjac.studies import servo_report as report

    prepared = study.prepare(robot, settings)
    _make_folder(out)
    with tqdm(total=settings.duration, unit="s", disable=None) as bar:
        result = study.run(prepared, progress=lambda t: bar.update(t - bar.n) and None)
    report.write(result, out)
    print(report.text(result))
    print(f"\nPictures, the run and summary.json are in {out}")
    return 0 if result.converged else 1


@app.command(name="arms")
def arms(
    robots: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = (),
    starts: int = 20,
    duration: float = 30.0,
    jobs: int | None = None,
    out: Path = Path("results/arms"),
) -> int:
    """Let every arm reach targets with a tool that its controller believes absent.

    Args:
        robots: Arms to try; all that load by name by default.
        starts: Seeded starts and targets for each arm, with gravity known and with gravity learnt.
        duration: Of each run, in s.
        jobs: Processes that share the work; as many as there are processors by default.
        out: Folder for table.md and summary.json.
    """
    from approxjac.studies import arms as study

    cases = study.cases(robots, starts, duration)
    _make_folder(out)
    with tqdm(total=len(cases), unit="run", disable=None) as bar:
        outcomes = study.run(cases, jobs, progress=lambda: bar.update() and None)
    (out / "table.md").write_text(study.table(outcomes), encoding="utf-8")
    summary = study.summary(outcomes)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(study.table(outcomes))
    print(f"table.md and summary.json are in {out}")
    return 0 if summary["verdict"] == "ok" else 1


@app.command(name="limiters")
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
    _make_folder(out)
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


@app.command(name="servo-study")
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
    _make_folder(out)
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


@app.command(name="certify")
def certify(
    cases: int = 500,
    seed: int = 0,
    jobs: int | None = None,
    out: Path = Path("results/certify"),
) -> int:
    """Hold the stability tests against simulations of random closed loops; measure what they miss.

    Exit code 1 means that a counterexample to a test was found.

    Args:
        cases: Random closed loops to test and to run.
        seed: Of all that is random.
        jobs: Processes that share the work; as many as there are processors by default.
        out: Folder for table.md, two_link.md, panda.md and summary.json.
    """
    from approxjac.studies import certify as study
    from approxjac.studies import certify_cases, certify_report, certify_shares, certify_two_link

    chosen = certify_cases.cases(cases, seed)
    _make_folder(out)
    with tqdm(total=len(chosen), unit="case", disable=None) as bar:
        outcomes = study.run(chosen, jobs, progress=lambda: bar.update() and None)
    two_link, shares = certify_two_link.run(), certify_shares.run()
    tables = {
        "table.md": certify_report.table(outcomes),
        "two_link.md": certify_report.two_link_table(two_link),
        "panda.md": certify_shares.table(shares),
    }
    for name, text in tables.items():
        (out / name).write_text(text, encoding="utf-8")
        print(text)
    summary = certify_report.summary(outcomes, two_link, shares)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(f"{', '.join(tables)} and summary.json are in {out}")
    return 0 if summary["verdict"] == "ok" else 1


@app.command(name="stability")
def stability(
    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME|FILE")],
    settings: Annotated[StabilitySettings, tyro.conf.OmitArgPrefixes],
    jobs: int = 1,
    out: Path = Path("results/stability"),
) -> int:
    """Tell whether a controller is stable before anything moves, by how much, and what to change.

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
    _make_folder(out)
    pool = ProcessPoolExecutor(jobs) if jobs > 1 else nullcontext()
    with pool as executor, tqdm(total=1.0, disable=None, bar_format=_SHARE) as bar:

        def tell(what: str, share: float) -> None:
            bar.set_description(what, refresh=False)
            bar.update(share - bar.n)

        result = study.run(case, executor, tell)
    report.write(result, out)
    print(report.text(result))
    print(f"\nPictures and summary.json are in {out}")
    return 0 if result.report.certified_by is not None else 1


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"approxjac {approxjac.__version__}")
        return 0
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show λ shows "?"
    try:
        arguments = with_file(arguments, _FROM_FILE)
        return int(app.cli(args=arguments, prog="approxjac", description=_DESCRIPTION))
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130
    except (ApproxJacError, OSError) as error:  # a full disk, a file that is a folder, …
        print(f"approxjac: {error}", file=sys.stderr)
        return 2


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {error}", given=out
        ) from error
