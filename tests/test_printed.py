"""What `print` shows of results: verdict first, plain words, rounded numbers, within a width."""

import re

import numpy as np
import pytest

import approxjac as aj
from approxjac import formatting

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
    plant = errors.plant(errors.believed)
    target = plant.sensor.value(np.array([0.6, 1.1]))
    study = aj.Study(law, errors, region, duration=0.2, latency=aj.Latency(period=4e-3))
    tolerated = study.tolerance(precision=0.5, draws=20)
    return {
        "gains": (gains, "K_p 100, K_v 50, joint damping 1"),
        "law": (law, "set-point law (6), K_p 100, "),
        "limited": (aj.TorqueLimited(law, aj.Limits(effort=50.0)), "set-point law (6), "),
        "tracking": (aj.TrackingController(task), "tracking law, "),
        "run": (aj.simulate(plant, law, target, [0.5, 1.2], 0.2, dt=1e-3), "error 0.1"),
        "report": (study.report(20), "certified, margin "),
        "rollouts": (study.rollouts(2), "converged: "),
        "map": (study.map({"error": (0.5, 1.0), "a": (1.0, 2.0)}, 1), "converged: "),
        "tolerance": (tolerated["certified"], "tolerated by one Lyapunov function "),
        "suggestion": (study.gains(3.0, test="stable", configurations=20), "gains: found, "),
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


@pytest.mark.parametrize(
    ("n", "total", "said"),
    [
        (0, 9, "0 %"),
        (4, 3001, "0.133 %"),
        (300, 3001, "10 %"),
        (9999, 10000, "99.9 %"),
        (7, 7, "100 %"),
    ],
)
def test_a_share_is_not_rounded_to_all_or_to_one_percent(n, total, said):
    assert formatting.share(n, total) == said
