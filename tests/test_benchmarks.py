"""What the benchmarks compare is the same law, and steps leave nothing behind. Nothing is timed."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import Dynamics

FOLDER = Path(__file__).parent / "benchmarks"


@pytest.fixture
def benchmark(monkeypatch):
    """A module of the benchmarks, by its name."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module


@pytest.mark.study
@pytest.mark.parametrize("name", ["two_link", "ur5", pytest.param("panda", marks=pytest.mark.long)])
def test_a_law_that_is_typed_in_gives_the_same_torque(name, benchmark):
    control_step = benchmark("control_step")
    _, _, inputs = control_step.arm(name)
    compared = 0
    for law in control_step.laws(name):
        if law.bare is None:
            continue
        step, m = law.ours, law.controller.task.n_x
        for q, v, x in inputs[:20]:
            ours, (torque, *rates) = step(q, v, x), law.bare(q, v, x[:m])
            if ours.status is aj.Status.NEAR_SINGULAR:
                continue  # ours is damped there
            assert_allclose(ours.torque, torque, rtol=1e-9, atol=1e-9)
            for rate in rates:
                assert_allclose(ours.state_rate, rate, rtol=1e-9, atol=1e-9)
            compared += 1
    assert compared > 100


def test_the_operational_space_torque_is_the_one_by_pinocchio(benchmark):
    control_step, others = benchmark("control_step"), benchmark("other_libraries")
    robot, _, inputs = control_step.arm("panda")
    step, task = others.operational_space(robot, slice(0, 3), np.zeros(3)), aj.PositionTask(robot)
    dynamics = Dynamics(robot)
    for q, v, x in inputs[:20]:
        J, M = task.jacobian(q), dynamics.M(q)
        force = np.linalg.inv(J @ np.linalg.inv(M) @ J.T) @ (-100.0 * x - 20.0 * J @ v)
        expected = J.T @ force + dynamics.inverse(q, v, np.zeros(7))
        assert_allclose(step(q, v, x)[0], expected, atol=1e-6)


@pytest.mark.long
def test_steps_leave_no_memory_behind(benchmark):
    control_step, memory = benchmark("control_step"), benchmark("memory")
    _, _, inputs = control_step.arm("panda")
    for law in control_step.laws("panda"):
        step = law.ours
        # below a byte a step, once in a few times, as other threads of a test run allocate, too
        assert any(memory.left_behind(step, inputs, 1500) < 1500 for _ in range(3)), law.name
