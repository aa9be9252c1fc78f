"""`approxjac stability`: a scenario → what the tests say of its loop."""

from __future__ import annotations

from pathlib import Path

from approxjac.cli.options import make_folder
from approxjac.errors import InvalidInputError
from approxjac.scenario import Scenario

_SHARE = "{desc}: {percentage:3.0f} %|{bar}| {elapsed}"


def stability(
    scenario: Scenario,
    jobs: int = 1,
    out: Path = Path("results/stability"),
) -> int:
    """Tell whether a controller is stable before anything moves, by how much, and what to change.

    Example: approxjac stability panda --object-length 0 0.3 --around 0 -0.5 0 -2 0 1.6 0.7

    Exit code 0 if the region is certified, 1 if not: of the loop as it runs, sampled and late as
    the scenario says; or in continuous time where gravity is learnt, as there it has to do.

    Args:
        scenario: The scenario.
        jobs: Processes that share the rollouts.
        out: Folder for figure1, workspace and map as .png and .svg, summary.json, scenario.toml.
    """
    from concurrent.futures import ProcessPoolExecutor
    from contextlib import nullcontext

    from tqdm import tqdm

    from approxjac.scenario import stability as study
    from approxjac.scenario import stability_report as report

    if jobs < 1:
        raise InvalidInputError(f"jobs must be >= 1, got {jobs}", given=jobs)
    loop = study.prepare(scenario)
    make_folder(out)
    pool = ProcessPoolExecutor(jobs) if jobs > 1 else nullcontext()
    with pool as executor, tqdm(total=1.0, disable=None, bar_format=_SHARE) as bar:

        def tell(what: str, share: float) -> None:
            bar.set_description(what, refresh=False)
            bar.update(share - bar.n)

        result = study.analyse(
            scenario, loop, executor, tell, lambda tests: bar.write(f"{loop.truth!r}\n{tests}\n")
        )
    report.write(result, out)
    print(report.consequences(result))
    told = report.told_of_map(result, out)
    if told:
        print("", *told, sep="\n")
    print(f"\nPictures and summary.json are in {out}")
    return 0 if result.report.passed else 1
