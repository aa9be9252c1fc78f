"""`approxjac simulate`: a scenario → a run → files and a verdict."""

import sys
from pathlib import Path

from approxjac.cli.options import make_folder, time_bar
from approxjac.errors import InvalidInputError
from approxjac.scenario import Scenario


def simulate(
    scenario: Scenario,
    view: bool = False,
    speed: float | None = None,
    port: int | None = None,
    out: Path = Path("results/simulate"),
) -> int:
    """Simulate an arm that reaches a target although its controller has a wrong robot or camera.

    Example: approxjac simulate panda --object-length 0.2 --believed-length 0 --seed 1

    Exit code 0 if the error ended within the tolerance, or a path was followed; 1 if not. Where it
    fell within the tolerance in the last tenth of the run, it is too late to judge: exit code 0.

    Args:
        scenario: The scenario.
        view: Show the run in the browser while it goes on; there the target and the believed length
            can be changed, and the run paused or stopped.
        speed: Speed of the run with --view, as a multiple of real time; 1 by default.
        port: Port of the page with --view on this machine; 7007 by default, or any free one.
        out: Folder for the pictures, run.npz, summary.json and scenario.toml.
    """
    from approxjac.scenario import build_scenario, recommended, run_scenario
    from approxjac.scenario import outcome as report

    for name, value in (("speed", speed), ("port", port)):
        if value is not None and not view:
            message = f"--{name} is for a run that is shown with --view, got {value:g} without"
            raise InvalidInputError(message, given=value)
    if view and scenario.loop.dt == "continuous":  # what is shown are steps
        scenario = scenario.with_values({"loop": {"dt": 1e-3}})
    built = build_scenario(recommended(scenario))
    make_folder(out)
    if built.warning:
        print(f"approxjac: warning: {built.warning}", file=sys.stderr)
    live = None
    if view:
        from approxjac.view import LiveView

        live = LiveView(
            speed=1.0 if speed is None else speed,
            port=port,
            believe=None if built.scenario.controller.unknown else built.believe,  # or x̂ tells it
            believed_length=scenario.believed.object.length,
        )
    with time_bar(scenario.run.duration, "simulation", disable=True if view else None) as bar:
        result = run_scenario(built, lambda t: bar.update(t - bar.n) and None, live)
    report.write(result, out)
    print(report.text(result))
    print(f"\nPictures, the run, its scenario and summary.json are in {out}")
    print(f"See it move: approxjac view {out / 'run.npz'}")
    return 1 if result.failed else 0
