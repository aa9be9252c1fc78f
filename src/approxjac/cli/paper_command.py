"""`approxjac paper`: the paper's two-link study."""

import json
from pathlib import Path

from approxjac.cli.options import make_folder, time_bar
from approxjac.errors import InvalidInputError
from approxjac.files import together, write_text


def paper(
    out: Path = Path("results/paper"),
    figures: tuple[int, ...] = (1, 3, 4, 5, 6, 7, 8),
    duration: float = 120.0,
) -> int:
    """Reproduce the paper's two-link study, Figures 1 and 3-8, with a verdict for each.

    Example: approxjac paper --figures 3 4

    Exit code 0 if every verdict is the paper's, 1 if not.

    Args:
        out: Folder for figN.png, figN.svg, figN.npz and summary.json, and, with the extra "view"
            installed, pages to see in a browser: index.html and figN.html.
        figures: Figures to make, such as "--figures 3 4".
        duration: Length of each run, in s.
    """
    from approxjac.paper import experiments as study
    from approxjac.paper import verdicts as report

    if not figures:
        raise InvalidInputError("figures must name at least one figure, got none", given=figures)
    for figure in set(figures) - {1, *study.EXPERIMENTS}:
        known = ", ".join(map(str, (1, *study.EXPERIMENTS)))
        raise InvalidInputError(f"figures must be among {known}, got {figure}", given=figure)
    make_folder(out)
    truth = study.build_arm()
    bound = None
    results = []
    experiments = [study.EXPERIMENTS[f] for f in sorted(set(figures)) if f != 1]
    with together(out) as folder, time_bar(max(1, len(experiments)) * duration, "figure 1") as bar:
        if 1 in figures:
            bar.set_description("figure 1")
            bound = study.jacobian_bound()
            report.write_bound(bound, folder)
        for i, experiment in enumerate(experiments):
            bar.set_description(f"figure {experiment.figure}")

            def advance(t: float, done: float = i * duration) -> None:
                bar.update(done + t - bar.n)

            result = study.run_experiment(experiment, duration, progress=advance)
            report.write_result(result, truth, folder)
            results.append(result)
        summary = report.summary(results, bound, duration)
        write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    print(report.table(results, bound))
    print(f"\nPictures, runs and summary.json are in {out}")
    if experiments:
        print(report.write_pages(results, out))
    return 0 if all(result.agrees_with_paper for result in results) else 1
