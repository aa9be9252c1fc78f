"""Compiled steps: the same answers as in NumPy, for every arm, law and argument."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import (
    CompiledSetpointController,
    DifferentiatedVelocity,
    Posture,
    RegressorGravity,
    compiled,
    machine_code,
)
from approxjac.errors import MeasurementError, MissingPackageError
from approxjac.law import Linear, Sine, Tanh, products, theta_hat_rate
from approxjac.robots import GravityRegressor
from approxjac.tasks import NonsingularTask

pytestmark = pytest.mark.study  # compiling takes its time in a fresh clone
CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
NAMES = ("torque", "state_rate", "status", "e", "J_hat", "limit_status", "slack")


def pair(task, gains=None, **options):
    """The same controller in NumPy and compiled."""
    return (
        aj.SetpointController(task, gains, **options),
        CompiledSetpointController(task, gains, **options),
    )


def measured(task, rng, size=0.1):
    """A state of the arm, and a target that is as far away as `size`."""
    robot = task.robot
    q = robot.random_configuration(rng)
    x = task.value(q)
    target = task.displaced(x, size * rng.normal(size=task.m))
    return aj.Measurement(0.0, q, 0.3 * rng.normal(size=robot.nv), x), target


def assert_same(ours, expected):
    """Equal to rounding where the law computes, else to the last bit."""
    scale = 1.0 + np.abs(expected.torque).max()
    assert_allclose(ours.torque / scale, expected.torque / scale, rtol=0, atol=1e-12)
    scale = 1.0 + np.abs(expected.state_rate).max(initial=0.0)
    assert_allclose(ours.state_rate / scale, expected.state_rate / scale, rtol=0, atol=1e-11)
    assert ours.status is expected.status
    assert ours.limit_status is expected.limit_status
    assert ours.slack == expected.slack
    assert_array_equal(ours.e, expected.e)
    assert_array_equal(ours.J_hat, expected.J_hat)


@pytest.fixture
def asked(monkeypatch):
    """Steps in which a compiled controller that is built from here on asked the ordinary way."""
    steps, ordinary = [], aj.SetpointController.evaluate

    def counted(controller, *arguments):
        if isinstance(controller, CompiledSetpointController):
            steps.append(arguments)
        return ordinary(controller, *arguments)

    monkeypatch.setattr(aj.SetpointController, "evaluate", counted)
    return steps


@pytest.fixture
def only_compiled(monkeypatch):
    """Controllers that are built from here on have nothing but their compiled steps."""

    def refuse(*arguments):
        pytest.fail("this step was not compiled")

    monkeypatch.setattr(aj.SetpointController, "evaluate", refuse)


def learning(robot, **options):
    return aj.AdaptiveGravity(robot, L=0.5, alpha=1.0, torque_limits=np.inf, **options)


LAWS = {
    "(6)": lambda task: {},
    "sine": lambda task: {"saturation": Sine(0.05)},
    "tanh, a γ each": lambda task: {"saturation": Tanh(0.1 * np.arange(1, task.m + 1))},
    "no gravity": lambda task: {"gravity": aj.NoGravity(task.robot)},
    "(28)": lambda task: {"gravity": learning(task.robot)},
    "(28), sine": lambda task: {"gravity": learning(task.robot), "saturation": Sine(0.05)},
}


@pytest.mark.parametrize("name", LAWS)
def test_on_every_arm_it_is_the_same_law(arm, name, rng, asked):
    task = aj.PositionTask(arm)
    plain, ours = pair(task, **LAWS[name](task))
    usual = 0
    for _ in range(20):
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        state *= rng.uniform(0.5, 1.5, len(state))
        expected = plain.evaluate(state, measurement, target)
        assert_same(ours.evaluate(state, measurement, target), expected)
        usual += expected.status is aj.Status.OK
    assert usual >= 5
    assert len(asked) == 20 - usual


def kinds(panda, kinova):
    """Controllers as (task, gains, options), one for each way through a step."""
    position, regressor = aj.PositionTask(panda), GravityRegressor(panda)
    held = panda.random_configuration(np.random.default_rng(1))
    symmetric = 0.1 * (np.eye(regressor.p) + 0.1)
    return {
        "one axis": (aj.PositionTask(panda, axes="z"), None, {}),
        "a plane, turned": (aj.PositionTask(panda, axes="zx"), None, {}),
        "axes in another order": (aj.PositionTask(panda, axes="yxz"), None, {}),
        "two frames, m = 5": (
            aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "yz")),
            aj.Gains(100.0, 20.0, 1.0),
            {},
        ),
        "two frames, learnt": (
            aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "yz")),
            aj.Gains(100.0, 20.0, 1.0),
            {"gravity": learning(panda)},
        ),
        "an image": (aj.ImageTask(panda, CAMERA), None, {}),
        "a nonsingular Jacobian": (
            NonsingularTask(position, {"panda_joint4": 0.3}),
            aj.Gains(400.0, 80.0, 1.0),
            {},
        ),
        "continuous joints": (aj.PositionTask(kinova), None, {"gravity": learning(kinova)}),
        "a posture": (position, None, {"posture": Posture(held, 5.0)}),
        "a posture, learnt": (
            position,
            None,
            {"posture": Posture(held, 5.0), "gravity": learning(panda)},
        ),
        "known θ": (position, None, {"gravity": RegressorGravity(regressor, regressor.theta)}),
        "bounds": (
            position,
            None,
            {"gravity": learning(panda, bounds=(regressor.theta - 0.1, regressor.theta + 0.1))},
        ),
        "a full L": (
            position,
            None,
            {"gravity": aj.AdaptiveGravity(regressor, symmetric, 1.0, torque_limits=np.inf)},
        ),
    }


KINDS = (
    "one axis", "a plane, turned", "axes in another order", "two frames, m = 5",
    "two frames, learnt", "an image", "a nonsingular Jacobian", "continuous joints", "a posture",
    "a posture, learnt", "known θ", "bounds", "a full L",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_controller(panda, kind, rng, asked):
    every = kinds(panda, aj.load_robot("kinova"))
    assert tuple(every) == KINDS
    task, gains, options = every[kind]
    plain, ours = pair(task, gains, **options)
    statuses = []
    for _ in range(30):
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        state += 0.2 * rng.normal(size=len(state))
        expected = plain.evaluate(state, measurement, target)
        assert_same(ours.evaluate(state, measurement, target), expected)
        statuses.append(expected.status)
    assert statuses.count(aj.Status.OK) > 10
    assert len(asked) == 30 - statuses.count(aj.Status.OK)


@pytest.mark.parametrize("name", LAWS)
def test_usual_steps_are_compiled_whatever_the_arrays_are(panda, name, rng, only_compiled):
    """Other strides, read-only, not aligned: one machine code takes them all."""
    task = aj.PositionTask(panda)
    ours = CompiledSetpointController(task, **LAWS[name](task))
    measurement, target = measured(task, rng, 0.01)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    measurement = measurement._replace(q=q)
    state = ours.initial_state(measurement)
    expected = ours.evaluate(state, measurement, target)
    assert expected.status is aj.Status.OK

    def unaligned(array):
        room = np.zeros(array.nbytes + 1, dtype=np.uint8)
        other = np.frombuffer(room, dtype=np.float64, offset=1, count=len(array))
        other.flags.writeable = True
        other[:] = array
        return other

    def read_only(array):
        other = array.copy()
        other.flags.writeable = False
        return other

    for change in (
        lambda a: np.repeat(a, 3)[::3],
        read_only,
        unaligned,
        lambda a: a[::-1].copy()[::-1],
    ):
        arrays = [change(a) for a in (measurement.q, measurement.v, measurement.x, target, state)]
        answer = ours.evaluate(arrays[4], aj.Measurement(0.0, *arrays[:3]), arrays[3])
        assert_array_equal(answer.torque, expected.torque)
        assert_array_equal(answer.state_rate, expected.state_rate)


def test_what_is_not_usual_is_answered_as_in_numpy(rng):
    """Lost, singular, beyond the limits, and enormous: the same status and the same torque."""
    task = aj.PositionTask(aj.load_robot("two_link"))
    learnt = aj.AdaptiveGravity(task.robot, L=0.5, alpha=1.0, torque_limits=100.0)
    seen = set()
    for options in ({}, {"gravity": learnt}, {"saturation": Sine(0.05)}):
        plain, ours = pair(task, aj.Gains(400.0, 80.0), **options)
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        for change in (
            {"x": np.full(2, np.nan)},
            {"x": np.array([0.1, np.inf])},
            {"x": np.array([0.1, 1e29])},
            {"x": np.array([0.1, 1e120])},
            {"x": measurement.x + 10.0},
            {"q": np.array([0.3, 0.0])},  # stretched
            {"v": np.full(2, 1e40)},
        ):
            there = measurement._replace(**change)
            expected = plain.evaluate(state, there, target)
            assert_same(ours.evaluate(state, there, target), expected)
            seen.add(expected.status)
    assert seen == {
        aj.Status.OK,
        aj.Status.MEASUREMENT_LOST,
        aj.Status.NEAR_SINGULAR,
        aj.Status.TORQUE_SATURATED,
    }


def test_what_is_wrong_is_refused_with_the_same_words(panda, rng):
    kinova = aj.load_robot("kinova")
    cases = 0
    for robot, gravity in ((panda, None), (panda, learning(panda)), (kinova, None)):
        task = aj.PositionTask(robot)
        plain, ours = pair(task, gravity=gravity)
        good, target = measured(task, rng)
        state = plain.initial_state(good)
        n, p = robot.nv, len(state)
        for arguments in (
            (state, good._replace(q=good.q[:-1]), target),
            (state, good._replace(q=good.q.tolist()), target),
            (state, good._replace(q=np.full(robot.nq, np.nan)), target),
            (state, good._replace(q=np.full(robot.nq, 3.0) if robot is kinova else "q"), target),
            (state, good._replace(v=np.zeros(n + 1)), target),
            (state, good._replace(v=np.zeros(n, dtype=int)), target),
            (state, good._replace(v=np.full(n, np.inf)), target),
            (state, good._replace(x=good.x[:-1]), target),
            (state, good._replace(x=good.x.astype(np.float32)), target),
            (state, good._replace(x=None), target),
            (state, good, target[:-1]),
            (state, good, target.tolist()),
            (state, good, np.full(3, np.nan)),
            (np.zeros(p + 1), good, target),
            (np.zeros(p, dtype=np.float32), good, target),
            (state.tolist(), good, target),
            (state, None, target),
            (state, (good.q, good.v, good.x), target),
        ):
            with pytest.raises(aj.errors.ApproxJacError) as expected:
                plain.evaluate(*arguments)
            with pytest.raises(type(expected.value)) as refused:
                ours.evaluate(*arguments)
            assert str(refused.value) == str(expected.value)
            cases += 1
    assert cases == 54


def outcome(controller, *arguments):
    """The torque and the status, or what was raised."""
    try:
        answer = controller.evaluate(*arguments)
    except (IndexError, TypeError, ValueError) as error:
        return type(error), str(error)
    return np.round(np.asarray(answer.torque), 9).tolist(), answer.status


class Wrong(aj.PositionTask):
    """A task with a mistake in its Jacobian."""

    mistake = staticmethod(lambda J: J)

    def jacobian(self, q, x=None):
        return self.mistake(super().jacobian(q, x))


@pytest.mark.parametrize("learnt", [False, True])
def test_a_jacobian_of_another_size_or_kind_is_no_usual_step(panda, learnt, rng, asked):
    """Machine code looks at no bounds: a size that is taken for another would be read beyond."""
    good = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    for axes, mistake in (
        ("xyz", lambda J: J[:1]),
        ("xyz", lambda J: J[:, :1]),
        ("xyz", lambda J: np.hstack([J, J])),
        ("z", lambda J: J[:, :1]),
        ("z", lambda J: np.vstack([J, J])),
        ("z", lambda J: J[0]),
        ("xyz", lambda J: J.astype(">f8")),  # the right numbers, in another order of bytes
        ("xyz", lambda J: J.astype(np.float32)),
        ("xyz", np.ma.masked_array),
    ):
        task = Wrong(panda, axes=axes)
        gravity = learning(panda) if learnt else None
        plain, ours = pair(task, aj.Gains(400.0, 80.0, 1.0), gravity=gravity)
        measurement = aj.Measurement(0.0, good, 0.1 * rng.normal(size=7), task.value(good))
        arguments = (ours.initial_state(measurement), measurement, measurement.x + 0.1)
        assert ours.evaluate(*arguments).status is aj.Status.OK
        assert asked == []
        task.mistake = mistake
        assert outcome(ours, *arguments) == outcome(plain, *arguments)
        assert len(asked) == 1
        asked.clear()


def test_arrays_of_other_classes_are_not_compiled(panda, asked, rng):
    """What a mask hides is not measured, and Numba would not see the mask."""
    task = aj.PositionTask(panda)

    class Tagged(np.ndarray):
        pass

    for gravity in (None, learning(panda)):
        plain, ours = pair(task, gravity=gravity)
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        for view in (lambda a: a.view(Tagged), np.ma.masked_array):
            for name in ("v", "x", "q"):
                there = measurement._replace(**{name: view(getattr(measurement, name))})
                arguments = (state, there, target)
                assert outcome(ours, *arguments) == outcome(plain, *arguments)
                assert len(asked) == 1
                asked.clear()


def test_a_rate_that_overflows_is_a_named_error(panda):
    task = aj.PositionTask(panda)
    gravity = aj.AdaptiveGravity(panda, L=1e60, alpha=1.0, torque_limits=np.inf)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    measurement = aj.Measurement(0.0, q, np.full(7, 1e300), task.value(q))
    for controller in pair(task, aj.Gains(1.0, 1e-290, 1e-290), gravity=gravity):
        with pytest.raises(MeasurementError, match="the torque overflows or is no number"):
            controller.evaluate(controller.initial_state(measurement), measurement, measurement.x)


def test_nothing_is_derived_from_it():
    text = "Mine cannot be derived from CompiledSetpointController, whose machine code would not "
    with pytest.raises(TypeError, match=text):
        type("Mine", (CompiledSetpointController,), {})


def test_a_whole_run_with_limits_ends_at_the_same_place(panda):
    truth, belief = panda.with_object(0.2, 0.5), panda.with_object(0.0)
    plant, task = aj.Plant(truth), aj.PositionTask(belief)
    target = plant.sensor.value(plant.ready_configuration()) + [0.1, -0.1, 0.1]
    ends = []
    for controller in pair(task, gravity=aj.AdaptiveGravity(belief)):
        limited = aj.TorqueLimited(controller, aj.Limits.of(belief))
        run = aj.simulate(plant, limited, target, duration=2.0, dt=1e-3)
        assert run.error_norm[-1] < 0.1 * run.error_norm[0]
        ends.append(run.q[-1])
    assert_allclose(ends[1], ends[0], atol=1e-9)


def test_made_from_one_it_is_compiled_too(panda):
    belief = panda.with_object(0.1)
    task = aj.PositionTask(panda)
    ours = CompiledSetpointController(task, posture=Posture(np.zeros(7), 1.0))
    assert type(ours.with_task(aj.PositionTask(belief))) is CompiledSetpointController
    assert type(ours.with_gravity(aj.NoGravity(panda))) is CompiledSetpointController
    assert repr(ours).startswith("CompiledSetpointController(law (6), PositionTask(")
    with pytest.raises(aj.InvalidInputError, match="cannot be changed once it is built"):
        ours.evaluate = None


@pytest.mark.parametrize("dtype", [">f8", np.float32, np.int64, np.float16, object, complex])
def test_numbers_of_other_types_are_refused(panda, dtype, asked):
    task = aj.PositionTask(panda)
    for gravity in (None, learning(panda)):
        ours = CompiledSetpointController(task, gravity=gravity)
        good = {"q": np.zeros(7), "v": np.zeros(7), "x": np.zeros(3), "target": np.ones(3)}
        good["state"] = np.zeros(0 if gravity is None else gravity.regressor.p)
        for name in good:
            given = good | {name: good[name].astype(dtype)}
            measurement = aj.Measurement(0.0, given["q"], given["v"], given["x"])
            with pytest.raises(aj.InvalidInputError, match=f"^{name} must be an array of float64"):
                ours.evaluate(given["state"], measurement, given["target"])
    assert len(asked) == 10


def test_what_is_not_compiled_is_refused(panda):
    class Own(Tanh):
        pass

    task = aj.PositionTask(panda)
    for given, text in (
        (
            {"task": task, "velocity": DifferentiatedVelocity()},
            "velocity of a CompiledSetpointController must be None: law (5) is not compiled, got "
            "DifferentiatedVelocity(time_constant=0.02); SetpointController takes it",
        ),
        (
            {"task": task, "saturation": Own(0.1)},
            "saturation of a CompiledSetpointController must be Linear, Sine or Tanh: others are "
            f"not compiled, got {Own(0.1)!r}; SetpointController takes it",
        ),
        (
            {"task": aj.PoseTask(panda)},
            "task of a CompiledSetpointController must be one whose error is x - x_d: others are "
            "not compiled, got PoseTask('panda', 'panda_hand_tcp'); SetpointController takes it",
        ),
    ):
        with pytest.raises(aj.InvalidInputError) as refused:
            CompiledSetpointController(**given)
        assert str(refused.value) == text


def test_without_numba_it_says_what_to_install(panda, monkeypatch):
    machine_code.compiled.cache_clear()
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'approxjac\[fast\]'$"):
        CompiledSetpointController(aj.PositionTask(panda))


def test_nothing_else_loads_numba():
    code = (
        "import sys, approxjac as aj\n"
        "aj.SetpointController(aj.PositionTask(aj.load_robot('panda')))\n"
        "assert 'numba' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# -- the functions that are compiled, as Python runs them ------------------------------------------


def test_its_functions_are_what_they_are_compiled_from(panda, rng):
    task = aj.PositionTask(panda)
    for saturation, kind in ((Linear(), 0), (Sine(0.05), 1), (Tanh(0.05), 2)):
        plain = aj.SetpointController(task, saturation=saturation, gravity=learning(panda))
        measurement, target = measured(task, rng)
        _, q, v, x, _ = measurement
        state = plain.initial_state(measurement)
        expected = plain.evaluate(state, measurement, target)
        constants = np.concatenate([*plain.diagonals, np.full(3, 0.05), [1e-3, kind]])
        J_hat, Z = task.jacobian(q), plain.adaptation.regressor.Z(q)
        g, limits = Z @ state, np.full(7, np.inf)
        torque, e, rate = np.empty(7), np.empty(3), np.empty(len(state))
        begin = (J_hat, v, x, target)
        assert compiled.known_gravity(*begin, g, constants, torque, e)
        assert_same(expected._replace(torque=torque, e=e), expected)
        more = (Z, state, plain.adaptation.L, 1.0)
        zero = np.zeros(7)
        made = limits, np.ones(7), torque, e, rate
        assert compiled.learnt_gravity(*begin, zero, constants, *more, *made)
        assert_same(expected._replace(torque=torque, e=e, state_rate=rate), expected)
        # and what is not usual
        for wrong in ((J_hat, v[1:], x, target), (J_hat, v, x + np.nan, target)):
            assert not compiled.known_gravity(*wrong, g, constants, torque, e)
            assert not compiled.learnt_gravity(*wrong, zero, constants, *more, *made)
        flat = (0.0 * J_hat, v, x, target)
        assert not compiled.known_gravity(*flat, g, constants, torque, e)
        for jacobian, most in ((flat[0], limits), (J_hat, 0.9 * np.abs(expected.torque))):
            made = most, *made[1:]
            assert not compiled.learnt_gravity(jacobian, *begin[1:], zero, constants, *more, *made)


def test_its_products_are_products(rng):
    for k, n in ((1, 1), (2, 3), (3, 7), (6, 6)):
        A, B = rng.normal(size=(k, n)), rng.normal(size=(n, k))
        x, y = rng.normal(size=n), rng.normal(size=k)
        for ours, a, b in (
            (machine_code.matrix_vector, A, x),
            (machine_code.vector_matrix, y, A),
            (machine_code.matrix_matrix, A, B),
        ):
            assert machine_code.product_of(a, b) is ours
            assert_allclose(ours(a, b), a @ b, atol=1e-14)
            assert_allclose(products.dot(a, b), a @ b, atol=1e-14)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same():
    """As on a robot whose files are read-only: here, a function that is in no file."""
    there = {}
    exec("def twice(a, out):\n    out[:] = 2.0 * a\n    return True", there)
    code = machine_code.compiled(there["twice"], (1,), 1, ())
    out = np.zeros(2)
    assert code(np.array([1.0, -3.0]), out)
    assert_array_equal(out, [2.0, -6.0])


def test_a_damaged_file_is_no_obstacle(tmp_path):
    """As after a power failure: what Numba kept is empty."""
    code = (
        "from approxjac.controllers import compiled, machine_code\n"
        "import numpy as np\n"
        "run = machine_code.compiled(compiled.is_small, (1, 1), 0, ())\n"
        "print(run(np.ones(2), np.ones(3)), run(np.full(2, np.nan), np.ones(3)))"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for _ in range(2):
        run = [sys.executable, "-c", code]
        done = subprocess.run(run, check=True, capture_output=True, text=True, env=environment)
        assert done.stdout == "True False\n"
        kept = [path for path in tmp_path.rglob("*") if path.is_file()]
        assert {path.suffix for path in kept} == {".nbi", ".nbc"}
        for path in kept:
            path.write_bytes(b"")


def test_an_equation_that_was_changed_is_compiled_anew(tmp_path):
    """What Numba keeps on disk is not used for other equations than those it was made from."""
    CompiledSetpointController(aj.PositionTask(aj.load_robot("ur5")), aj.Gains(100.0, 20.0, 1.0))
    shutil.copytree(Path(aj.__file__).parent, tmp_path / "approxjac")  # with what is kept of that
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*known_gravity*.nb?")}
    assert kept
    code = (
        "import numpy as np, approxjac as aj\n"
        "task = aj.PositionTask(aj.load_robot('ur5'))\n"
        "q = np.array([0.1, -1.0, 1.2, 0.3, 0.4, 0.5])\n"
        "m = aj.Measurement(0.0, q, np.ones(6), task.value(q))\n"
        "c = aj.controllers.CompiledSetpointController(task, aj.Gains(100.0, 20.0, 1.0))\n"
        "print(*c.evaluate(np.zeros(0), m, m.x + 0.1).torque, aj.__file__)"
    )

    def torque():
        run = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        *numbers, path = run.stdout.split()
        assert path.startswith(str(tmp_path))
        return np.array(numbers, dtype=float)

    before = torque()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*known_gravity*.nb?")} == kept
    equation = tmp_path / "approxjac" / "law" / "torque.py"
    text = equation.read_text()
    assert text.count("kp * s + kv * dot(J_hat, v)") == 1
    equation.write_text(text.replace("kp * s + kv * dot(J_hat, v)", "2.0 * kp * s"))
    after = torque()
    assert np.abs(after - before).max() > 1.0


def test_learning_stops_at_the_motors_as_that_of_the_ordinary_law(panda, rng):
    """Where |Yθ̂| is beyond what θ̂ may ask for, and the torque of the law is not."""
    task = aj.PositionTask(panda)
    low = 10.0  # N m
    gravity = aj.AdaptiveGravity(panda, bounds=(-100.0, 100.0), torque_limits=low)
    given = aj.SetpointController(task, gravity=gravity).adaptation
    given = given._replace(torque_limits=np.full(7, np.inf))
    plain = aj.SetpointController(task, gravity=given)
    quick, seen = CompiledSetpointController(task, gravity=given), 0
    for _ in range(50):
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        expected = plain.evaluate(state, measurement, target)
        assert_same(quick.evaluate(state, measurement, target), expected)
        g = expected.gravity
        unbounded = theta_hat_rate(
            given.L, given.Y(measurement.q, expected.J_hat),
            plain.passive_output(expected, measurement.v, given.alpha),
        )  # fmt: skip
        seen += not np.allclose(expected.state_rate, unbounded) and (np.abs(g) > low).any()
    assert seen > 5
