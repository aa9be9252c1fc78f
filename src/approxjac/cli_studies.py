"""The commands that run a whole study: arguments → a study → files and a summary."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from approxjac.errors import InvalidInputError


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

    Example: approxjac paper --figures 3 4

    Exit code 0 if every verdict is the paper's, 1 if not.

    Args:
        out: Folder for figN.png, figN.svg, figN.npz and summary.json, and, with the extra "view"
            installed, pages to see in a browser: index.html and figN.html.
        figures: Figures to make, such as "--figures 3 4".
        start: Posture q(0) at the start, in degrees.
        target: Posture whose image is the target, in degrees.
        friction: Viscous friction B at both joints, N m s/rad.
        gamma: Saturation of the error on the sensor, in m; "None" is s(e) = e.
        inertia: Uniform rods, or point masses at their middles.
        duration: Length of each run, in s.
    """
    from approxjac import paper as study
    from approxjac.paper import report
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
    make_folder(out)
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
    if experiments:
        print(report.write_pages(results, out))
    return 0 if all(result.agrees_with_paper for result in results) else 1


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


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to.

    Raises:
        InvalidInputError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {error}", given=out
        ) from error
