"""What objects say of themselves: one line that one wants to read, and no address in memory."""

import dataclasses

import numpy as np
import pytest

import approxjac as aj

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


@pytest.fixture(scope="module")
def belief(panda):
    return panda.with_object(0.0)


@pytest.fixture(scope="module")
def controller(belief):
    gains = aj.Gains(kp=400.0, kv=80.0, damping=1.0)
    return aj.SetpointController(aj.PositionTask(belief), gains, gravity=aj.NoGravity(belief))


@pytest.fixture(scope="module")
def run(panda):
    plant = aj.Plant(panda)
    controller = aj.SetpointController(aj.PositionTask(panda))
    return aj.simulate(plant, controller, plant.sensor.value(Q) + 0.03, Q, 3.0, dt=2e-3)


def test_texts_of_what_one_builds(panda, belief):
    task, regressor = aj.PositionTask(belief), aj.GravityRegressor(belief)
    texts = {
        aj.Dynamics(panda): "Dynamics('panda')",
        aj.ModelGravity(belief): "ModelGravity('panda')",
        aj.NoGravity(belief): "NoGravity('panda')",
        aj.RegressorGravity(regressor, np.arange(12.0)): (
            "RegressorGravity('panda', theta=[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11])"
        ),
        aj.AdaptiveGravity(belief): "AdaptiveGravity('panda', 12 parameters)",
        aj.AdaptiveGravity(belief, 0.5, 2.0): (
            "AdaptiveGravity('panda', 12 parameters, L=0.5, alpha=2)"
        ),
        aj.AdaptiveGravity(belief, np.eye(12)): (
            "AdaptiveGravity('panda', 12 parameters, L=a matrix)"
        ),
        aj.Gains(400.0, (80.0, 80.0, 70.0)): "Gains(kp=400, kv=[80, 80, 70])",
        aj.Gains([1 / 3] * 3, 80.0, 1.0): "Gains(kp=0.3333, kv=80, damping=1)",
        aj.Posture(Q, 3.0): "Posture(q=[0, -0.5, 0, -2, 0, 1.6, 0.7], stiffness=3)",
        aj.Limits(): "Limits()",
        aj.Limits(effort=np.full(7, 87.0), rate=1e3): "Limits(effort=87, rate=1000)",
        aj.Limits(position=([-1.0, -2.0], [1.0, 2.0])): "Limits(position=([-1, -2], [1, 2]))",
        aj.Sensing(): "Sensing()",
        aj.Sensing(x_noise=1e-3, x_rate=30.0, x_lost=[(1.0, 2.0)]): (
            "Sensing(x_noise=0.001, x_rate=30, x_lost=((1.0, 2.0),))"
        ),
        aj.PlanarCamera(0.05, 3.0): "PlanarCamera(focal_length=0.05, distance=3)",
        aj.Plant(panda): "Plant('panda', PositionTask('panda', 'panda_hand_tcp', 'xyz'))",
        aj.Plant(panda, None, 0.5, coulomb=0.1, actuator_delay=2e-3, torque_limits=87.0): (
            "Plant('panda', PositionTask('panda', 'panda_hand_tcp', 'xyz'), friction=0.5, "
            "coulomb=0.1, actuator_delay=0.002, torque_limits=87)"
        ),
        aj.SetpointController(task, aj.Gains(4.0, 2.0, 1.0)): (
            "SetpointController(law (6), PositionTask('panda', 'object_tip', 'xyz'), "
            "Gains(kp=4, kv=2, damping=1), ModelGravity('panda'))"
        ),
    }
    for thing, text in texts.items():
        assert repr(thing) == text


def test_texts_of_what_passes_between(panda, controller):
    measurement = aj.Plant(panda.with_object(0.0)).measure(0.25, Q, np.zeros(7))
    x = ", ".join(f"{entry:.4g}" for entry in measurement.x)
    assert repr(measurement) == (
        f"Measurement(t=0.25 s, q=[0, -0.5, 0, -2, 0, 1.6, 0.7], v=[0, 0, 0, 0, 0, 0, 0], x=[{x}])"
    )
    refused = aj.Measurement(0.25, np.zeros(1), np.zeros(1), None)
    assert repr(refused) == "Measurement(t=0.25 s, q=[0], v=[0], x=None)"
    answer = controller.evaluate(np.zeros(0), measurement, measurement.x)
    assert repr(answer).startswith("Evaluation(OK, torque=[")
    assert repr(answer).endswith("e=[0, 0, 0])")
    limited = answer._replace(limit_status=aj.LimitStatus.PROOF_KEPT)
    assert repr(limited).startswith("Evaluation(OK, PROOF_KEPT, slack=0 W, torque=[")


def test_a_run_is_printed_as_a_short_block(run):
    head, error, torque, status = str(run).splitlines()
    assert head == "panda, 3 s, 1501 samples"
    settled = run.t[np.nonzero(run.error_norm > 0.01 * run.error_norm[0])[0][-1] + 1]
    assert error.startswith("error   0.052 -> ")
    assert error.endswith(f" m, below 1 % of the start from {settled:.3g} s on")
    assert torque == f"torque  at most {np.abs(run.tau).max():.3g} N m (panda_joint4)"
    assert status == "status  OK 1501"
    limited = dataclasses.replace(run, limit_status=np.full(1501, int(aj.LimitStatus.FREE)))
    assert str(limited).endswith("\nlimits  FREE 1501")
    short = dataclasses.replace(run, error=np.ones_like(run.error))
    assert "error   1.73 -> 1.73 m\n" in str(short)
    assert repr(run).startswith("Trajectory('panda', 3 s, 1501 samples; |e| 0.052 -> ")


def test_texts_of_the_stability_tests(panda, controller):
    box = aj.JointBox.around(panda, Q, 0.05)
    weightless = panda.with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(weightless, object_length=(0.0, 0.1), object_axis="x")
    report = aj.stability_report(
        controller.with_task(errors.believed_task()), errors, box, postures=20, runs=1
    )
    assert repr(report).startswith("StabilityReport('panda': ")
    assert repr(report).endswith(f"on {box!r}; print it for the tests)")
    assert repr(report.local).startswith("LocalTest(stable at 100 % of 39 postures, slowest decay ")
    assert repr(report.theorem1).startswith("Theorem1(does not hold: p = ")
    assert repr(report.matrix["free"]).startswith("MatrixTest('free': ")
    assert repr(report.scenarios).startswith("Scenarios(")
    assert repr(report.rollouts.runs[0]).startswith("Rollout(0: ")
    plant = aj.Plant(weightless.with_object(0.1, axis="x"))
    local = aj.local_stability(plant, controller, Q)
    assert repr(local) == f"LocalStability({local})"
    assert repr(aj.lyapunov(plant, controller, Q, np.zeros(7), plant.sensor.value(Q), 0.3)) == (
        "LyapunovValue(V=0 J, W=0 W)"
    )
    diverged = aj.stability.Rollout(3, Q, Q, Q, np.inf, np.nan, False, True, False)
    assert repr(diverged) == "Rollout(3: diverged)"
    found = dataclasses.replace(diverged, diverged=False, converged=True, settling_time=1.0)
    assert repr(found) == "Rollout(3: converged after 1 s, ended inf off)"


def test_nothing_public_is_printed_as_an_address():
    for name in aj.__all__:
        kind = getattr(aj, name)
        if isinstance(kind, type) and not issubclass(kind, Exception | aj.Task):
            own = kind.__repr__ is not object.__repr__
            assert own or getattr(kind, "_is_protocol", False), name
