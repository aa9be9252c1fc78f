"""What a controller asks of a saturation, of the library or of the user's own."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers.saturation import require_saturation
from approxjac.errors import MeasurementError
from approxjac.law import Linear, Sine, Tanh

BUILT_IN = (Sine, Tanh)
TWO_LINK = aj.load_robot("two_link")
TASKS = {
    1: aj.PositionTask(TWO_LINK, axes="x"),
    2: aj.PositionTask(TWO_LINK, axes="xz"),
    3: aj.PositionTask(aj.load_robot("panda")),
    6: aj.PoseTask(aj.load_robot("panda")),
}
gammas = st.floats(1e-6, 1e6)


@dataclass
class Own:
    """γ tanh(e/γ) in the shortest form, and parts to exchange."""

    gamma: float = 0.1
    c_bar: float = 0.5

    def s(self, e):
        return self.gamma * np.tanh(e / self.gamma)

    def S(self, e):
        return self.gamma**2 * np.log(np.cosh(e / self.gamma))

    def ds(self, e):
        return 1.0 - np.tanh(e / self.gamma) ** 2


def own(**parts):
    """Return an own saturation with some parts exchanged, called with it and e."""
    return type("Own", (Own,), parts)()


def fault_of(saturation, task):
    """What is said against a saturation; nothing if it is taken."""
    try:
        require_saturation(saturation, task)
    except aj.InvalidInputError as error:
        return str(error)
    return ""


@given(gammas)
def test_the_librarys_own_are_taken_whatever_their_gamma(gamma):
    for kind in BUILT_IN:
        assert fault_of(kind(gamma), TASKS[1]) == ""
        assert fault_of(kind(gamma), TASKS[6]) == ""


@given(st.lists(gammas, min_size=3, max_size=3))
def test_and_whatever_the_gamma_of_each_coordinate(gamma):
    for kind in BUILT_IN:
        assert fault_of(kind(gamma), TASKS[3]) == ""


@pytest.mark.parametrize("m", TASKS)
def test_no_saturation_is_taken(m):
    assert fault_of(Linear(), TASKS[m]) == ""


def test_where_two_points_lie_on_either_side_of_a_kink():
    """However the sine's last point, γπ/2, lies to those that are looked at."""
    for gamma in np.geomspace(1.0, np.sqrt(10.0), 500):
        assert fault_of(Sine(gamma), TASKS[1]) == ""


class Algebraic(Own):
    def s(self, e):
        return e / np.sqrt(1 + (e / self.gamma) ** 2)

    def S(self, e):
        return self.gamma**2 * (np.sqrt(1 + (e / self.gamma) ** 2) - 1)  # cancels near 0

    def ds(self, e):
        return (1 + (e / self.gamma) ** 2) ** -1.5


class Clip(Own):
    def s(self, e):
        return np.clip(e, -self.gamma, self.gamma)

    def S(self, e):
        inside = np.abs(e) < self.gamma
        return np.where(inside, e * e / 2, self.gamma * (np.abs(e) - self.gamma / 2))

    def ds(self, e):
        return (np.abs(e) < self.gamma).astype(int)


class Unbounded(Own):
    """γ asinh(e/γ)"""

    def s(self, e):
        return self.gamma * np.arcsinh(e / self.gamma)

    def S(self, e):
        u = e / self.gamma
        return self.gamma**2 * (u * np.arcsinh(u) - np.sqrt(1 + u * u) + 1)

    def ds(self, e):
        return 1 / np.sqrt(1 + (e / self.gamma) ** 2)


@pytest.mark.parametrize("gamma", [1e-6, 1e-3, 0.2, 1.0, 50.0, 1e6])
@pytest.mark.parametrize("kind", [Own, Algebraic, Clip, Unbounded])
def test_own_ones_in_plain_formulas_are_taken(kind, gamma):
    """Also those that cancel near 0, overflow far away or have kinks."""
    for m in TASKS:
        assert fault_of(kind(gamma), TASKS[m]) == ""


def raises(*_):
    raise ZeroDivisionError("division by zero")


def radial(self, e):
    norm = np.linalg.norm(e, axis=-1, keepdims=True)
    return self.gamma * np.tanh(norm / self.gamma) * e / np.where(norm > 0, norm, 1.0)


def in_place(self, e):
    e /= self.gamma
    return self.gamma * np.tanh(e)


class OnlySlopes:
    def s(self, e): ...
    def S(self, e): ...
    def ds(self, e): ...


def slope_two(self, e):
    return 2.0 - 2.0 * np.tanh(2.0 * e / self.gamma) ** 2


FAULTS = {
    "a number": (0.2, "got 0.2: it has no s, S, ds, c_bar"),
    "a class": (Tanh, "that is a class, give an object of it"),
    "parts that are missing": (OnlySlopes(), "it has no c_bar"),
    "another length of γ": (Sine((0.1, 0.2)), "fails for an e of shape (3,) with ValueError: "),
    "a part that fails": (
        own(ds=raises),
        "ds(e) fails for an e of shape (3,) with ZeroDivisionError: division by zero (e has "
        "shape (3,) or (N, 3), and is not to be changed)",
    ),
    "an e that is changed": (own(s=in_place), "s(e) fails for an e of shape (3,) with ValueError"),
    "a potential that is summed": (
        own(S=lambda _, e: np.sum(e * e) / 2),
        "S(e) must have the shape of e, (3,), got ()",
    ),
    "slope 2 at 0": (
        own(s=lambda f, e: f.gamma * np.tanh(2.0 * e / f.gamma), ds=slope_two),
        "its slope ds(0) must be 1 in every coordinate, got [2.0, 2.0, 2.0]; another slope belongs "
        "into the gains, such as kp",
    ),
    "slope 2 in one coordinate": (
        own(ds=lambda _, e: np.ones(3) * (1.0, 2.0, 1.0) + 0.0 * e),
        "its slope ds(0) must be 1 in every coordinate, got [1.0, 2.0, 1.0]",
    ),
    "no slope at 0": (own(ds=lambda _, e: np.sin(e) / e), "got [nan, nan, nan]"),
    "an offset of s": (own(s=lambda _, e: e + 0.1), "s(0) must be 0, got [0.1, 0.1, 0.1]"),
    "an offset of S": (own(S=lambda _, e: e * e / 2 + 1), "S(0) must be 0, got [1.0, 1.0, 1.0]"),
    "a slope that is told wrongly": (
        own(s=lambda f, e: f.gamma * np.tanh(2.0 * e / f.gamma)),
        "ds(e) must be the slope of s, got s(e) = ",
    ),
    "a wrong slope only beyond": (
        own(ds=lambda f, e: np.where(np.abs(e) < f.gamma, 1.0 - np.tanh(e / f.gamma) ** 2, 0.0)),
        "ds(e) must be the slope of s, got s(e) = ",
    ),
    "the wrong sign": (
        own(s=lambda _, e: e - 2e-3 * np.sign(e), ds=lambda _, e: np.ones(e.shape)),
        "s(e) must have the sign of e, got s(e) = ",
    ),
    "an error that is too small to be seen": (
        own(s=lambda _, e: np.where(np.abs(e) > 1e-3, e, 0.0), ds=lambda _, e: np.ones(e.shape)),
        "ds(e) must be the slope of s, got s(e) = 0, ",
    ),
    "a wrong potential": (own(S=lambda _, e: e * e), "s(e) must be the slope of S, got s(e) = "),
    "a wrong potential only beyond": (
        own(S=lambda f, e: np.minimum(f.gamma**2 * np.log(np.cosh(e / f.gamma)), f.gamma**2)),
        "s(e) must be the slope of S, got s(e) = ",
    ),
    "one that falls": (
        own(
            s=lambda f, e: e * np.exp(-((e / f.gamma) ** 2) / 2),
            S=lambda f, e: f.gamma**2 * -np.expm1(-((e / f.gamma) ** 2) / 2),
            ds=lambda f, e: (1 - (e / f.gamma) ** 2) * np.exp(-((e / f.gamma) ** 2) / 2),
        ),
        "s must not fall anywhere, ds(e) >= 0, got s(e) = ",
    ),
    "an overflow": (
        own(S=lambda f, e: f.gamma**2 * np.log(np.cosh(e / f.gamma) ** 10) / 10),
        "s, S and ds must be finite, got s(e) = 0.1, S(e) = inf and ds(e) = 0 at e = ",
    ),
    "entries that are mixed": (own(s=radial), "s must act entry by entry, got s(e) = "),
    "c_bar": (Linear(c_bar=5.0), "S(e) must be >= c_bar s(e)², c_bar 5, got s(e) = "),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_does_not_hold_is_named(name):
    saturation, fault = FAULTS[name]
    with pytest.raises(aj.InvalidInputError, match=re.escape(fault)) as caught:
        require_saturation(saturation, TASKS[3])
    assert caught.value.given is saturation
    valid = "saturation must be Linear(), Sine(gamma) or Tanh(gamma) with one gamma or 3 for "
    also = f", or a law.Saturation of your own, got {saturation!r}: "
    assert str(caught.value).startswith(valid)
    assert also in str(caught.value)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, None, "half"])
def test_constants_are_positive_numbers(value):
    text = "c_bar of a saturation must be a finite number > 0, got "
    with pytest.raises(aj.InvalidInputError, match=text):
        require_saturation(Own(c_bar=value), TASKS[3])


def test_the_mistake_of_an_own_saturation_is_the_cause():
    with pytest.raises(aj.InvalidInputError) as caught:
        require_saturation(own(S=raises), TASKS[3])
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_the_controller_asks():
    gains = aj.Gains(10.0, 10.0, 1.0)
    assert isinstance(aj.SetpointController(TASKS[3], gains, saturation=Own()).saturation, Own)
    with pytest.raises(aj.InvalidInputError, match=r"ds\(0\) must be 1"):
        aj.SetpointController(TASKS[3], gains, saturation=own(ds=slope_two))


def test_a_slope_of_two_is_a_stiffness_of_two():
    """γ tanh(2e/γ) is 2 (γ/2) tanh(e/(γ/2)): said in the gains, the local test sees it."""
    true_camera = PlanarCamera(focal_length=0.05, distance=3.0)
    believed_camera = PlanarCamera(focal_length=0.05, distance=3.0, roll=np.radians(60.0))
    plant = aj.Plant(TWO_LINK, aj.ImageTask(TWO_LINK, true_camera))
    task, goal = aj.ImageTask(TWO_LINK, believed_camera), np.radians([90.0, 90.0])

    def local(kp, gamma):
        law = aj.SetpointController(task, aj.Gains(kp, 7500.0), saturation=Own(gamma))
        return aj.local_stability(plant, law, goal)

    assert local(5000.0, 0.01).stable
    assert not local(10000.0, 0.005).stable


def test_a_report_of_an_own_saturation_is_that_of_the_librarys():
    believed = aj.PositionTask(TWO_LINK.with_object(0.5, 0.4), axes="xz")
    arm = TWO_LINK.with_object(0.5, 0.5)
    plant = aj.Plant(arm, aj.PositionTask(arm, axes="xz"))
    box = aj.JointBox(arm, np.array([0.2, 1.0]), np.array([0.6, 1.6]))
    own_report, report = (
        aj.Study(
            aj.SetpointController(believed, aj.Gains(60.0, 40.0, 1.0), saturation=s), plant, box
        ).report(50)
        for s in (Own(0.1), Tanh(0.1))
    )  # fmt: skip
    own_text, text = (" ".join(str(each).split()) for each in (own_report, report))  # as wrapped
    named = text.replace("saturation Tanh (gamma 0.1 m)", "saturation Own (your own)")
    assert own_text == named != text


def test_what_rounding_leaves_at_zero_is_no_fault():
    for left in (1e-18, -3e-15):
        assert fault_of(own(S=lambda self, e, left=left: Own.S(self, e) + left), TASKS[3]) == ""


class Gap(Tanh):
    """Not a number at one error, which no look at some hundred of them finds."""

    def s(self, e):
        return np.where(np.abs(e - 0.0123) < 1e-9, np.nan, super().s(e))


def test_a_saturation_that_fails_on_the_way_is_an_error_and_no_torque():
    task, q = TASKS[3], np.array([0, -0.5, 0, -2, 0, 1.6, 0.7])
    controller = aj.SetpointController(task, saturation=Gap(0.1))
    x = task.value(q)
    measurement = aj.Measurement(0.0, q, np.zeros(7), x)
    state = controller.begin(measurement)
    assert np.isfinite(controller.evaluate(state, measurement, x - 0.02).torque).all()
    with pytest.raises(MeasurementError, match="the torque overflows or is no number"):
        controller.evaluate(state, measurement, x - 0.0123)
    limited = aj.TorqueLimited(aj.SetpointController(task, saturation=Gap(0.1)))
    with pytest.raises(MeasurementError, match="the torque overflows or is no number"):
        limited.step(limited.initial_state(measurement), measurement, x - 0.0123, 1e-3)


@pytest.mark.parametrize(
    ("saturation", "words"),
    [
        (None, "no saturation"),
        (Sine(0.05), "saturation Sine (gamma 0.05 m)"),
        (Tanh((0.05, 0.1)), "saturation Tanh (gamma 0.05 0.1 m)"),
        (Own(), "saturation Own (your own)"),
        (type("Straight", (Linear,), {"__module__": "mine"})(), "saturation Straight (your own)"),
    ],
)
def test_a_law_names_its_saturation_as_no_run_can_be_repeated_without(saturation, words):
    law = aj.SetpointController(TASKS[2], aj.Gains(100.0, 50.0), saturation=saturation)
    assert f", {words}; gravity " in " ".join(str(law).split())
