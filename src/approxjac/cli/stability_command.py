"""`approxjac stability`: a scenario → what the tests say of its loop."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from approxjac.cli.options import make_folder, options_of, with_options
from approxjac.errors import InvalidInputError
from approxjac.formatting import numbers
from approxjac.scenario import Scenario

_LONG = {
    "rollouts": "rollouts: simulating runs",
    "tolerance": "looking how large errors each test tolerates",
    "map": "making the map (--map-points 0 leaves it out)",
    "gains": "looking for gains, up to some minutes",
}


def stability(
    scenario: Scenario,
    suggest_gains: bool = False,
    jobs: int = 1,
    out: Path = Path("results/stability"),
) -> int:
    """Tell whether a controller is stable before anything moves, by how much, and what to change.

    Example: approxjac stability panda --object-length 0 0.3 --around 0 -0.5 0 -2 0 1.6 0.7

    Exit code 0 if the region is certified, 1 if not: of the sampled loop with its delays as
    the scenario says; or in continuous time where gravity is learnt, as there it has to do.

    Args:
        scenario: The scenario.
        suggest_gains: Find gains with which a report of 200 configurations certifies the errors
            where gravity is known, in place of a report. They settle within --settling-time, 1 s by
            default, and within --limits; scenario.toml has them, if some are found.
        jobs: How many processes share the rollouts.
        out: Folder for map.png and .svg, summary.json and scenario.toml.
    """
    from concurrent.futures import ProcessPoolExecutor
    from contextlib import nullcontext

    from approxjac.scenario import judge

    if jobs < 1:
        raise InvalidInputError(f"jobs must be >= 1, got {jobs}", given=jobs)
    if suggest_gains:
        return _suggest(scenario, out)
    study = judge.prepare(scenario)
    make_folder(out)
    pool = ProcessPoolExecutor(jobs) if jobs > 1 else nullcontext()
    with pool as executor:
        progress = long_work(_LONG)
        result = judge.analyse(
            scenario,
            study,
            executor,
            progress,
            lambda report: print(report, end="\n\n", flush=True),
        )
    judge.write(result, out)
    names = {each.key: each.names[0] for each in options_of(stability)}
    if follows := with_options(names, judge.consequences(result, out)):
        print(follows, end="\n\n")
    print(f"Pictures and summary.json are in {out}")
    return 0 if result.report.passed else 1


def _suggest(scenario: Scenario, out: Path) -> int:
    from approxjac.scenario import judge

    make_folder(out)
    suggestion, found = judge.suggested(scenario, long_work(_LONG))
    judge.write_gains(suggestion, found, out)
    print(suggestion)
    if found is None:
        print(f"\nsummary.json is in {out}; without gains no scenario.toml is written")
        return 1
    for name in ("kp", "kv", "damping"):
        print(f"  --{name} {numbers(getattr(found.controller, name))}")
    print(f"\nsummary.json and scenario.toml are in {out}")
    print(f"What a whole report says: approxjac stability {out / 'scenario.toml'}")
    return 0


def long_work(texts: Mapping[str, str]) -> Callable[[str, float], None] | bool:
    """Return how to show progress: by bars, or where none are shown by the text of each part."""
    if sys.stderr.isatty():
        return True
    left = dict(texts)

    def tell(what: str, share: float) -> None:
        if what in left:
            print(f"approxjac: {left.pop(what)}", file=sys.stderr, flush=True)

    return tell
