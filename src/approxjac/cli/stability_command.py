"""`approxjac stability`: a scenario → the stability report of its loop."""

import sys
from pathlib import Path

from approxjac.cli.options import make_folder
from approxjac.errors import InvalidInputError
from approxjac.files import write_text
from approxjac.scenario import Scenario


def stability(scenario: Scenario, jobs: int = 1, out: Path = Path("results/stability")) -> int:
    """Test whether a controller is stable, and with what margin, before anything moves.

    Example: approxjac stability panda --object-length 0 0.3 --around 0 -0.5 0 -2 0 1.6 0.7

    Exit code 0 if moves or starts in the region are certified, and nothing is refuted; 1 if not.
    Certificates are of the sampled loop with its delays as the scenario says; where gravity is
    learnt, of the loop in continuous time.

    Args:
        scenario: The scenario.
        jobs: Number of processes that share the rollouts.
        out: Folder for report.txt, map.png and .svg, summary.json and scenario.toml.
    """
    from concurrent.futures import ProcessPoolExecutor
    from contextlib import nullcontext

    from approxjac.scenario import judge

    if jobs < 1:
        raise InvalidInputError(f"jobs must be >= 1, got {jobs}", given=jobs)
    study = judge.prepare(scenario)
    make_folder(out)

    def report(text: object) -> None:  # before rollouts for a map, which take longest
        write_text(out / "report.txt", f"{text}\n")
        print(text, end="\n\n", flush=True)

    pool = ProcessPoolExecutor(jobs) if jobs > 1 else nullcontext()
    with pool as executor:
        result = judge.analyse(scenario, study, executor, sys.stderr.isatty(), report)
    judge.write(result, out)
    if follows := judge.consequences(result, out):
        print(follows, end="\n\n")
    print(f"Pictures and summary.json are in {out}")
    return 0 if result.report.covers else 1
