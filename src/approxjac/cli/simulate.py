"""`approxjac simulate`: a scenario → a run → files and a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from approxjac.cli.output import Live, make_folder, time_bar
from approxjac.scenario import Scenario

_NOT_LIVE = Live()


def simulate(
    scenario: Scenario,
    live: Annotated[Live, tyro.conf.OmitArgPrefixes] = _NOT_LIVE,
    save: Path | None = None,
    out: Path = Path("results/simulate"),
) -> int:
    """Let an arm reach a target although its controller believes a wrong robot, or a wrong camera.

    Example: approxjac simulate panda --object-length 0.2 --believed-length 0 --seed 1

    Exit code 0 if the error ended within the tolerance, 1 if not.

    Args:
        scenario: The scenario.
        live: View of the run while it goes on.
        save: Write the scenario to this .toml file, too.
        out: Folder for the pictures, run.npz, summary.json and scenario.toml.
    """
    if live.view and scenario.loop.dt == "continuous":  # what is shown are steps
        scenario = scenario.with_values({"loop": {"dt": 1e-3}})
    built = scenario.build()
    make_folder(out)
    if save is not None:
        scenario.save(save)
    observer = live.observer(built.believe, scenario.believed.object.length)
    with time_bar(scenario.run.duration, hidden=live.view) as progress:
        result = built.run(progress, observer)
    from approxjac.scenario import report

    report.write(result, out)
    print(report.text(result))
    print(f"\nPictures, the run, its scenario and summary.json are in {out}")
    print(f"See it move: approxjac view {out / 'run.npz'}")
    return 0 if result.converged else 1
