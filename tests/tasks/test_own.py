"""A task of one's own: three methods are enough for everything."""

import pickle

import numpy as np
import pinocchio as pin
import pytest
from lyapunov_decrease import lyapunov
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.tasks import FrameKinematics

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
POINT = np.array([0.2, 0.3, 0.1])


class Distance(aj.Task):
    """Distance of the tip from a point, and its height over the ground."""

    def __init__(self, robot):
        super().__init__(robot, ("distance", "height"), ("m", "m"))
        self._tip = FrameKinematics(robot, robot.tip)

    def value(self, q):
        p = self._tip.position(q)
        return np.array([np.linalg.norm(p - POINT), p[2]])

    def jacobian(self, q, x=None):
        J = self._tip.jacobian(q)[:3]
        away = self._tip.position(q) - POINT
        return np.array([away / np.linalg.norm(away) @ J, J[2]])

    def on(self, robot):
        return Distance(robot)


@pytest.fixture(scope="module")
def loop(panda):
    truth, belief = panda.with_object(0.2, 0.5), panda.with_object(0.0, 0.5)
    sensor = Distance(truth)
    controller = aj.SetpointController(
        sensor.on(belief), gravity=aj.controllers.ModelGravity(truth)
    )
    return aj.Plant(truth, sensor), controller, sensor


def test_three_methods_make_a_task_and_all_that_is_public_is_documented(panda):
    assert aj.Task.__abstractmethods__ == {"value", "jacobian", "on"}
    for name in dir(Distance(panda)):
        if not name.startswith("_"):
            member = getattr(aj.Task, name, None)
            is_function = callable(member) or isinstance(member, property)
            assert member.__doc__ if is_function else f"        {name}: " in aj.Task.__doc__, name


def test_an_attribute_of_ones_own_that_the_task_has_already_is_refused(panda):
    class Far(Distance):
        def __init__(self, robot):
            super().__init__(robot)
            self.origin = POINT

    with pytest.raises(aj.InvalidInputError, match="origin of a Far"):
        Far(panda)


class Unseen(Distance):
    """Nowhere, as far as its Jacobian says."""

    def jacobian(self, q, x=None):
        return super().jacobian(q) * np.nan


class Short(Distance):
    """Without a row for the height."""

    def jacobian(self, q, x=None):
        return super().jacobian(q)[:1]


class Listed(Distance):
    """A value that is no array."""

    def value(self, q):
        return super().value(q).tolist()


@pytest.mark.parametrize(
    ("kind", "said"),
    [(Unseen, "jacobian .* finite"), (Short, r"jacobian .*\(2, 7\)"), (Listed, "value .* array")],
)
@pytest.mark.parametrize("law", [aj.SetpointController, aj.TrackingController])
def test_one_that_is_written_wrongly_is_refused_by_the_method(kind, said, law, panda):
    with pytest.raises(aj.InvalidInputError, match=said):
        law(kind(panda))


@pytest.mark.parametrize("is_held", [pytest.param(False, marks=pytest.mark.study), True])
def test_it_is_brought_to_its_target_in_spite_of_a_wrong_tool(loop, is_held):
    plant, controller, sensor = loop
    start = pin.integrate(plant.robot.model, Q, np.full(7, 0.1))
    if is_held:
        controller = aj.HeldMeasurement(controller, unseen=0.02)
    run = aj.simulate(plant, controller, sensor.value(Q), start, 3.0, dt=1e-3)
    assert np.abs(run.error[0]).max() > 0.02
    assert np.abs(run.error[-1]).max() < 1e-4


def test_it_has_a_local_test_a_certificate_and_rates(loop):
    plant, controller, sensor = loop
    assert aj.local_stability(plant, controller, Q).stable
    v = np.linspace(-1.0, 1.0, 7)
    after, before = (
        sensor.jacobian(pin.integrate(sensor.robot.model, Q, s * v)) for s in (1e-6, -1e-6)
    )
    assert_allclose(sensor.jacobian_dot(Q, v), (after - before) / 2e-6, atol=1e-7)
    assert not sensor.jacobian_dot(Q, np.zeros(7)).any()
    found = lyapunov(plant, controller, Q, v, sensor.value(Q) + 0.01, alpha=0.1)
    assert found.V > 0.0


def test_it_is_copied_and_printed(loop):
    sensor = loop[2]
    again = pickle.loads(pickle.dumps(sensor))
    assert_allclose(again.jacobian(Q), sensor.jacobian(Q), atol=0)
    assert repr(again) == "Distance('panda')"


def test_a_sensor_that_sees_nothing_says_so_with_its_value(loop):
    class Wall(Distance):
        def value(self, q):
            x = super().value(q)
            return x if x[1] < 0.5 else np.full(2, np.nan)

    plant, controller, sensor = loop
    run = aj.simulate(
        aj.Plant(plant.robot, Wall(plant.robot)),
        controller,
        sensor.value(Q) * 0.9,
        Q,
        0.01,
        dt=1e-3,
    )
    lost = np.isnan(run.x_measured).all(axis=1)
    assert lost.all() == (sensor.value(Q)[1] >= 0.5)
    assert np.isfinite(run.tau).all()


@pytest.mark.parametrize(
    ("labels", "units", "text"),
    [
        (
            ("d", "h"),
            ("m",),
            r"units must be one for each of the labels \('d', 'h'\), got \('m',\)",
        ),
        ("abcdefgh", "mmmmmmmm", r"\(m <= n_v\), got m = 8 for panda with n_v = 7"),
    ],
)
def test_coordinates_that_cannot_be_are_refused(panda, labels, units, text):
    class Wrong(Distance):
        def __init__(self, robot):
            aj.Task.__init__(self, robot, labels, units)

    with pytest.raises(aj.InvalidInputError, match=text):
        Wrong(panda)


@pytest.mark.parametrize("bad", [Q[:6], Q * np.nan, "text", None, Q.astype(complex), [Q]])
def test_a_jacobian_looks_at_its_configuration(panda, bad):
    for task in (Distance(panda), aj.PositionTask(panda), aj.PoseTask(panda)):
        with pytest.raises(aj.InvalidInputError, match="q must"):
            task.jacobian(bad)
    assert_allclose(aj.PositionTask(panda).jacobian(Q.tolist()), aj.PositionTask(panda).jacobian(Q))
