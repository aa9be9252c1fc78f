"""What `print` shows of results: verdict first, plain words, rounded numbers, within a width."""

import re

import numpy as np
import pytest

import approxjac as aj
from approxjac import formatting
from approxjac.stability import stability_map

INTERNAL = re.compile(
    r"[A-Z][A-Za-z]+\(|`|\*\*|array\(|\w+=|None|True|False|np\.|[A-Z]+_[A-Z]+|\d\.\d{7}"
)


@pytest.fixture(scope="module")
def results():
    """Name → a result of each kind, and how its text begins."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.3))
    region = aj.JointBox.around(arm, [0.5, 1.2], 0.2)
    task, gains = errors.believed_task(), aj.Gains(100.0, 50.0, 1.0)
    law = aj.SetpointController(task, gains, gravity=aj.NoGravity(arm))
    few = {"configurations": 20}
    brief = {"duration": 0.2, "dt": 4e-3}
    plant = errors.plant(errors.believed)
    target = plant.sensor.value(np.array([0.6, 1.1]))
    grid = {"names": ("error", "a"), "x": (0.5, 1.0), "y": (1.0, 2.0), "coarse": 2, "targets": 4}
    tolerated = aj.tolerance(law, errors, region, precision=0.5, **few)
    return {
        "gains": (gains, "K_p 100, K_v 50, joint damping 1"),
        "law": (law, "set-point law (6), K_p 100, "),
        "limited": (aj.TorqueLimited(law, aj.Limits(effort=50.0)), "set-point law (6), "),
        "tracking": (aj.TrackingController(task), "tracking law T, "),
        "run": (aj.simulate(plant, law, target, [0.5, 1.2], 0.2, dt=1e-3), "error 0.1"),
        "report": (aj.stability_report(law, errors, region, **few), "certified: "),
        "rollouts": (aj.rollouts(law, errors, region, runs=2, **brief), "converged: "),
        # one run a point, with errors that multiply each other
        "map": (
            stability_map(law, errors, region, runs=1, **grid, **few, **brief),
            "map over error and a: ",
        ),
        "tolerance": (tolerated["matrix"], "tolerated by the matrix form (not "),
        "suggestion": (
            aj.suggest_gains(errors, region, test="local", settling_time=3.0, **few),
            "gains: found, ",
        ),
    }


@pytest.mark.parametrize("width", [60, 100])
def test_what_is_printed_is_for_people(results, width, monkeypatch):
    monkeypatch.setattr(formatting, "width", lambda: width)
    for name, (result, begins) in results.items():
        text = str(result)
        assert text.startswith(begins), name
        assert not INTERNAL.search(text), (name, INTERNAL.search(text))
        assert max(map(len, text.splitlines())) <= width, name


def test_the_width_is_that_of_the_terminal_or_fixed(monkeypatch):
    assert formatting.width() == 100  # of no terminal
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "72")
    assert formatting.width() == 72
