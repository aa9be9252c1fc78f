"""Starts that stay, of arms without joints to spare: level sets within a box."""

import itertools

import numpy as np
import pytest

import approxjac as aj
from approxjac.controllers import Latency
from approxjac.paper import experiments as paper


@pytest.mark.parametrize(
    ("figure", "half_width", "at_least"),
    [
        pytest.param(4, 0.3, 0.05, marks=pytest.mark.study),
        (6, 0.8, 0.15),
        pytest.param(7, 0.8, 0.14, marks=pytest.mark.study),
    ],
)
def test_starts_of_the_papers_figures_stay(figure, half_width, at_least):
    """Nearly in continuous time; from the corners, where errors are largest."""
    plant, controller = paper.build(paper.EXPERIMENTS[figure], paper.Setup())
    q = np.array(paper.Setup().target)
    region, target = aj.JointBox.around(plant.robot, q, half_width), plant.sensor.value(q)
    report = aj.Study(
        controller, plant, region, target=target, latency=Latency(period=1e-05)
    ).report(200)
    found = report.attraction
    assert found.radius >= at_least
    assert 0.0 < found.level <= report.sampled.level
    for corner in itertools.product((-1.0, 1.0), repeat=2):
        run = aj.simulate(
            plant, controller, target, q + found.radius * np.array(corner), 20.0, dt=None
        )
        assert all(region.contains(at) for at in run.q)
        assert run.error_norm[-1] < run.error_norm[0]
