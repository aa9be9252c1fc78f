"""A controller in C: what compilers say of it, its bits, and what it refuses."""

import ctypes
import functools
import itertools
import re
import shutil
import subprocess

import numpy as np
import pinocchio as pin
import pytest
from arms import SEVERAL
from beliefs import belief_of
from own_parts import Springs, of_ones_own

import approxjac as aj
from approxjac.codegen.backends.c99 import sampled_step
from approxjac.controllers import (
    AwayFromStops,
    DifferentiatedVelocity,
    FrictionCompensation,
    HeldMeasurement,
    Posture,
    PredictedMeasurement,
    RegressorGravity,
)
from approxjac.interface import LimitStatus, Measurement
from approxjac.robots import Friction, GravityRegressor

STATUSES = tuple(aj.Status)
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
OF_C_AND_CPP = {"gcc": "g++", "clang": "clang++"}
OF_CLANG = (pytest.mark.study, pytest.mark.long)  # where gcc runs by default, and in CI
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZED = ["-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
EXACT = "-ffp-contract=off"
NAMES = "controller.h", "controller.c", "selftest.c", "CMakeLists.txt"
CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
OPTIONS = (
    "-O0", "-O3", "-Os", "-Ofast", "-ffast-math", "-ffinite-math-only", "-fno-honor-nans",
    "-fno-honor-infinities", "-ffp-model=fast", "-ffp-model=strict", "-funsafe-math-optimizations",
    "-fassociative-math -fno-signed-zeros -fno-trapping-math", "-freciprocal-math",
    "-fno-signed-zeros", "-fno-trapping-math", "-fapprox-func", "-frounding-math", "-march=native",
    "-march=native -ffp-contract=fast", "-ffp-contract=off -march=native", "-mfpmath=387",
    "-mfpmath=both", "-ffast-math -fno-finite-math-only", "-fno-math-errno", "-fno-builtin",
    "-fshort-enums", "-ffloat-store", "-funroll-loops -O3", "-flto",
)  # fmt: skip
INPUTS = "state", "q", "v", "x", "target"
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="no gcc and no clang here")


def law_6(arm, **options):
    return aj.SetpointController(aj.PositionTask(arm), **options)


def law_28(arm, **options):
    return law_6(arm, gravity=aj.AdaptiveGravity(arm), **options)


def limited(law, share, **options):
    effort = share * np.minimum(law.task.robot.effort_limits, 100.0)
    return aj.TorqueLimited(law, aj.Limits(effort=effort), **options)


def known(arm):
    regressor = GravityRegressor(arm)
    return RegressorGravity(regressor, regressor.theta)


CASES = {
    "panda (6)": ("panda", law_6),
    "panda (6), limits": ("panda", lambda arm: limited(law_6(arm), 0.4)),
    "panda (6), clipped, linear, posture": (
        "panda",
        lambda arm: limited(
            law_6(
                arm,
                saturation=aj.law.Linear(),
                posture=Posture([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], 5.0),
            ),
            0.4,
            proof=False,
        ),
    ),
    "panda (28), limits, away from stops": (
        "panda",
        lambda arm: limited(law_28(arm, posture=AwayFromStops()), 0.4),
    ),
    "panda (6), pose, limits": (
        "panda",
        lambda arm: limited(aj.SetpointController(aj.PoseTask(arm)), 0.4),
    ),
    "panda (6), image": (
        "panda",
        lambda arm: aj.SetpointController(aj.ImageTask(arm, CAMERA)),
    ),
    "ur5 (28)": ("ur5", law_28),
    "ur5 (28), friction": (
        "ur5",
        lambda arm: limited(law_28(arm, friction=FrictionCompensation(Friction(coulomb=9.0))), 0.4),
    ),
    "ur5 (5), sine": (
        "ur5",
        lambda arm: law_6(
            arm,
            velocity=DifferentiatedVelocity(0.02),
            saturation=aj.law.Sine(0.05),
            gravity=known(arm),
        ),
    ),
    "kinova (6), limits": (
        "kinova",
        lambda arm: limited(law_6(arm, posture=AwayFromStops()), 2.0),
    ),
    "kinova (5), (29)": ("kinova", lambda arm: law_28(arm, velocity=DifferentiatedVelocity())),
}


SMALL = {"two_link (5), sine": ("two_link", CASES["ur5 (5), sine"][1])}  # with all options
# of which the others have the parts
IN_CPP = ("panda (6), image",)


PART_OF_OTHERS = ("panda (6)", "ur5 (28)", "kinova (6), limits")


def some(*words, long=()):
    """The cases as parameters, with those by default whose names end like one of some words."""
    return [
        pytest.param(
            name,
            marks=[]
            if name.endswith(words)
            else pytest.mark.long
            if name in long
            else pytest.mark.study,
        )
        for name in CASES
    ]


@functools.cache
def built(case):
    robot, make = (CASES | SMALL)[case]
    controller = make(aj.load_robot(robot))
    return controller, sampled_step(controller)


def compiled(folder, *options, compiler=None):
    """Compile the controller, with other files among the options."""
    command = [compiler or COMPILERS[0], *STRICT, *options, "controller.c", "-lm"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr[:2000]
    return folder


def header_number(folder, name):
    text = (folder / "controller.h").read_text(encoding="utf-8")
    return int(re.search(rf"_{name} = (-?\d+)", text)[1])


class InC:
    """The controller as a shared library."""

    def __init__(self, controller, folder, level="-O0", compiler=None):
        aj.export_c(controller, folder)
        compiled(folder, level, EXACT, "-shared", "-fPIC", "-o", "controller.so", compiler=compiler)
        task, nv = controller.task, controller.task.robot.nv
        library = ctypes.CDLL(str(folder / "controller.so"))
        prefix = task.robot.name
        self.step_function = getattr(library, f"{prefix}_step")
        self.init_function = getattr(library, f"{prefix}_init")
        self.n_state = header_number(folder, "N_STATE")
        double, integer = ctypes.c_double, ctypes.c_int
        self.State = double * max(self.n_state, 1)

        class Now(ctypes.Structure):
            _fields_ = (
                ("t", double), ("q", double * task.robot.nq), ("v", double * nv),
                ("x", double * task.n_x), ("t_x", double),
            )  # fmt: skip

        class Target(ctypes.Structure):
            _fields_ = (
                ("x", double * task.n_x), ("v", double * task.measured.m),
                ("a", double * task.measured.m),
            )  # fmt: skip

        class Answer(ctypes.Structure):
            _fields_ = (
                ("torque", double * nv), ("e", double * task.m), ("gravity", double * nv),
                ("J_hat", double * (task.m * nv)), ("slack", double), ("status", integer),
                ("limit_status", integer),
            )  # fmt: skip

        self.Now, self.Target, self.answer = Now, Target, Answer()

    def now(self, measurement):
        """A measurement in C, whose t_x is NaN where it is not known."""
        t, q, v, x, t_x = measurement
        q, v, x = ((ctypes.c_double * len(each))(*each) for each in (q, v, x))
        return self.Now(t, q, v, x, np.nan if t_x is None else t_x)

    def init(self, measurement):
        """Return the state before the first step, or None where it was refused."""
        state = self.State()
        is_done = self.init_function(state, ctypes.byref(self.now(measurement)))
        return np.array(state[: self.n_state]) if is_done else None

    def step(self, state, q, v, x, target, dt, t=0.0, t_x=None):
        """Return status, state and answer: name → array."""
        kept, now = self.State(*state), self.now(Measurement(t, q, v, x, t_x))
        wanted = target if isinstance(target, aj.Target) else aj.Target(target)
        parts = ([0.0] * len(self.Target().v) if each is None else each for each in wanted)
        wanted = self.Target(*((ctypes.c_double * len(each))(*each) for each in parts))
        status = self.step_function(
            kept, *map(ctypes.byref, (now, wanted)), ctypes.c_double(dt), ctypes.byref(self.answer)
        )
        found = {
            name: np.atleast_1d(np.array(getattr(self.answer, name), dtype=float))
            for name, _ in self.answer._fields_
        }
        assert status == self.answer.status
        return status, np.array(kept[: self.n_state]), found


@pytest.fixture(scope="module")
def in_c_of(tmp_path_factory):
    """A case in C, made once, and the folder of its files."""

    @functools.cache
    def made(case):
        folder = tmp_path_factory.mktemp("case")
        return InC(built(case)[0], folder), folder

    return made


def law_of(step):
    """The law inside of limits."""
    return getattr(step.controller, "_law", step.controller)


def draws(step, count, seed=0, at_bounds=0.1):
    """Inputs of steps (rows, N): near and far, lost, saturated, fast, near singular poses."""
    law = law_of(step)
    task, robot, rng = law.task, law.task.robot, np.random.default_rng(seed)
    q = np.array([robot.random_configuration(rng) for _ in range(min(count, 500))])
    q = q[rng.integers(len(q), size=count)]
    singular = singular_configurations(task)
    where = rng.random(count) < 0.1
    q[where] = singular[rng.integers(len(singular), size=where.sum())]
    v = rng.normal(size=(count, robot.nv)) * 10.0 ** rng.uniform(-3.0, 0.5, size=(count, 1))
    scale = 10.0 ** rng.uniform(-4.0, 1.0, size=(count, 1))
    x = np.array([task.value(each) for each in q])
    x += 0.01 * rng.normal(size=x.shape)
    target = x + scale * rng.normal(size=x.shape)
    if task.n_x != task.m:  # of poses, some that are near, and others anywhere
        target = np.where(scale < 0.1, target, rng.permuted(x, axis=0))
    x[rng.random(count) < 0.03, 0] = np.nan
    x[rng.random(count) < 0.02, -1] = np.inf
    first = Measurement(0.0, q[0], v[0], np.zeros(task.n_x))
    p, state = law.resting, np.tile(step.initial_state(first), (count, 1))
    state[:, :p] *= 1.0 + 0.3 * rng.normal(size=(count, p))
    state[:, :p] += 0.3 * rng.normal(size=(count, p))
    if law.adaptation is not None and law.adaptation.bounds is not None:
        lower, upper = law.adaptation.bounds
        p = len(lower)  # of θ̂: friction has others
        for bound in (lower, upper):
            at = rng.random((count, p)) < at_bounds
            state[:, :p] = np.where(at & np.isfinite(bound), bound, state[:, :p])
        if not at_bounds:
            inside = lower + (upper - lower) * rng.uniform(0.1, 0.9, size=(count, p))
            state[:, :p] = np.where(np.isfinite(upper - lower), inside, state[:, :p])
    if law.velocity is not None:
        seen = np.where(np.isfinite(x), x, 0.0)
        state[:, p : law.size] = seen + 0.01 * rng.normal(size=x.shape)
    return {
        "q": q, "v": v, "x": x, "target": target, "state": state, "dt": np.full((count, 1), 1e-3),
        "t": np.zeros((count, 1)), "t_x": np.full((count, 1), np.nan),
        "target_v": np.zeros((count, task.measured.m)),
        "target_a": np.zeros((count, task.measured.m)),
    }  # fmt: skip


@functools.cache
def singular_configurations(task):
    """Configurations that minimize σ_min of J, from random ones, and next to them."""
    from scipy.optimize import minimize

    robot, rng, found = task.robot, np.random.default_rng(8), []

    def at(motion):
        return pin.integrate(robot.model, robot.neutral(), motion)

    def least(motion):
        J = task.jacobian(at(motion))
        return np.linalg.svd(J, compute_uv=False)[-1] if np.isfinite(J).all() else np.inf

    for _ in range(4):
        best = minimize(least, rng.normal(size=robot.nv), method="Nelder-Mead").x
        found += [at(best + 10.0**k * rng.normal(size=robot.nv)) for k in (-9, -4, -3, -2)]
    return np.array(found)


def assert_same_bits(controller, step, in_c, count, seed=0):
    """Assert that C and NumPy give the same bits; return statuses that were given."""
    given = draws(step, count, seed)
    right = step.in_numpy()(**{name: value.T for name, value in given.items()})
    right, inputs = np.concatenate([*right.values()]).T, [given[name] for name in INPUTS]
    lost, seen = ~np.isfinite(given["x"]).all(axis=1), set()
    at_e = step.controller.task.robot.nv + in_c.n_state
    for k, row in enumerate(zip(*inputs, strict=True)):
        status, after, found = in_c.step(*row, 1e-3)
        all_found = np.concatenate([(found | {"after": after})[name] for name in step.outputs])
        expected = right[k]
        if lost[k]:
            e = slice(at_e, at_e + step.controller.task.m)
            assert not np.isfinite(all_found[e]).all()
            all_found[e] = expected[e] = 0.0
        assert all_found.tobytes() == expected.tobytes(), k
        assert np.isfinite(all_found).all()
        seen.add((STATUSES[status].name, LimitStatus(int(found["limit_status"][0])).name))
    return seen


@needs_compiler
@pytest.mark.parametrize("case", some("panda (6), limits", "posture"))
def test_it_gives_the_bits_of_numpy(case, in_c_of):
    controller, step = built(case)
    seen = assert_same_bits(controller, step, in_c_of(case)[0], 1000)
    statuses, limits = {status for status, _ in seen}, {limit for _, limit in seen}
    assert {"OK", "MEASUREMENT_LOST"} <= statuses
    if isinstance(step.controller.task, aj.PositionTask):
        assert "NEAR_SINGULAR" in statuses
    if isinstance(controller, aj.TorqueLimited) and case.startswith("panda"):
        wanted = {"PROOF_KEPT", "PROOF_GIVEN_UP"} if controller.proof else set()
        assert wanted | {"FREE", "LIMITED"} <= limits


@needs_compiler
@pytest.mark.parametrize(
    "k", [pytest.param(k, marks=() if k == 6 else pytest.mark.study) for k in range(8)]
)
def test_what_is_ones_own_is_the_same_in_c(panda, k, tmp_path, rng):
    """200 steps of a task's, a saturation's, gravity's and a law's of one's own, and a held x.

    The torque of the last one depends on time.
    """
    controller = of_ones_own(panda)[k]
    in_c, task = InC(controller, tmp_path), controller.task
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    target = task.value(q) + 0.05
    x, state = target, controller.initial_state(Measurement(0.0, q, np.zeros(7), target))
    for step in range(200):
        now, v = q + 0.1 * np.sin(1e-2 * step + np.arange(7.0)), 0.1 * rng.normal(size=7)
        x = x if step % 30 else task.value(now)
        t = 1e-3 * step
        after, expected = controller.step(state, Measurement(t, now, v, x), target, 1e-3)
        status, found, answer = in_c.step(state, now, v, x, target, 1e-3, t)
        assert status == expected.status
        scale = 1.0 + np.abs(expected.torque).max()
        np.testing.assert_allclose(answer["torque"] / scale, expected.torque / scale, atol=1e-12)
        np.testing.assert_allclose(found, after, rtol=1e-12, atol=1e-12)
        state = after


@needs_compiler
@pytest.mark.long
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("case", CASES)
def test_it_gives_the_bits_of_numpy_over_a_million_steps(case, compiler, tmp_path):
    """10⁶ steps together, of what compilers make with all optimizations."""
    controller, step = built(case)
    in_c = InC(controller, tmp_path, "-O3", compiler)
    for seed in range(13):
        assert_same_bits(controller, step, in_c, 10_000, seed + 1)


@pytest.mark.parametrize("case", some("limits", "posture", "stops", "(29)"))
def test_it_is_the_controller(case):
    """The same torques, states and statuses as those of the controller in Python."""
    controller, step = built(case)
    assert_is_the_controller(controller, step, draws(step, 100, seed=7, at_bounds=0.0))


@pytest.mark.parametrize("case", some("limits", "posture", long=PART_OF_OTHERS))
def test_at_singular_configurations_it_is_the_controller(case):
    """There a preferred posture fades out, and Ĵ⁺ is damped: to rounding at rank loss itself."""
    controller, step = built(case)
    given, task = draws(step, 100, seed=8, at_bounds=0.0), step.controller.task
    singular = singular_configurations(task)
    given["q"] = singular[np.arange(100) % len(singular)]
    given["x"] = np.array([task.value(q) for q in given["q"]])
    given["target"] = np.roll(given["x"], 1, axis=0)
    assert_is_the_controller(controller, step, given)


def assert_is_the_controller(controller, step, given):
    found = step.in_numpy()(**{name: value.T for name, value in given.items()})
    learning = law_of(step).adaptation
    for k, row in enumerate(zip(*(given[name] for name in INPUTS), strict=True)):
        state, q, v, x, target = row
        after, answer = controller.step(state, Measurement(0.0, q, v, x), target, 1e-3)
        assert found["status"][0, k] == answer.status
        assert found["limit_status"][0, k] == answer.limit_status
        torque = found["torque"][:, k]
        most = max(1.0, np.abs(answer.torque).max())
        assert torque == pytest.approx(answer.torque, abs=1e-8 * most)
        if np.isfinite(answer.slack):
            assert found["slack"][0, k] == pytest.approx(answer.slack, rel=1e-8, abs=1e-8)
        if learning is None or (np.abs(answer.gravity) < learning.motors).all():
            assert found["after"][:, k] == pytest.approx(after, rel=1e-8, abs=1e-8)


@needs_compiler
@pytest.mark.parametrize(
    ("case", "compiler"),
    [
        pytest.param(
            each.values[0], k, marks=each.marks if k == "gcc" else OF_CLANG[bool(each.marks)]
        )
        for each in some("panda (6), limits", long=PART_OF_OTHERS)
        for k in COMPILERS
    ],
)
def test_the_self_test_passes_and_sanitizers_find_nothing(case, compiler, in_c_of):
    _, folder = in_c_of(case)
    compiled(folder, "-O0", *SANITIZED, "selftest.c", "-o", "selftest", compiler=compiler)
    output = subprocess.run(
        [folder / "selftest"], capture_output=True, text=True, check=True
    ).stdout
    assert output == "50 of 50 steps to the bit; largest difference of a torque 0\n"


def is_refused(folder, compiler, options):
    """Whether a compiler refuses the controller because of its options, at a line of its own."""
    command = [compiler, *STRICT, *options.split(), "-fsyntax-only", "controller.c"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return made.returncode != 0 and "compile this with" in made.stderr


def self_test(folder, compiler, options):
    """Compile controller and self-test with some options; return how the self-test ends."""
    compiled(folder, *options.split(), "selftest.c", "-o", "selftest", compiler=compiler)
    return subprocess.run([folder / "selftest"], capture_output=True, text=True)


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", ["-ffinite-math-only", "-ffast-math", "-Ofast"])
def test_options_that_drop_comparisons_with_nan_are_refused(options, compiler, in_c_of):
    _, folder = in_c_of("panda (6), limits")
    assert is_refused(folder, compiler, options)
    assert not is_refused(folder, compiler, "-O2")


@pytest.mark.skipif("clang" not in COMPILERS, reason="no clang here")
@pytest.mark.parametrize(
    "options",
    ["-fno-honor-nans", pytest.param("-funsafe-math-optimizations", marks=pytest.mark.study)],
)
def test_options_of_clang_without_a_macro_are_refused_at_each_step(options, tmp_path):
    aj.export_c(law_6(aj.load_robot("two_link")), tmp_path)
    assert "see REFUSED_BUILD" in self_test(tmp_path, "clang", f"-O1 {options}").stdout
    main = """#include "controller.h"
        int main(void) {
            two_link_state state = {{0.0}};
            two_link_measurement now = {0.0, {0.4, 0.9}, {0.0, 0.0}, {1.0, 1.0}, 0.0};
            two_link_target target = {{1.0, 1.0}, {0.0, 0.0}, {0.0, 0.0}};
            two_link_answer answer;
            int is_begun = two_link_init(&state, &now);
            int status = two_link_step(&state, &now, &target, 1e-3, &answer);
            int is_zero = answer.torque[0] == 0.0 && answer.torque[1] == 0.0;
            return is_begun || status != TWO_LINK_REFUSED_BUILD || !is_zero;
        }
    """
    (tmp_path / "main.c").write_text(main.rstrip(" "))
    compiled(tmp_path, "-O1", options, "main.c", "-o", "main", compiler="clang")
    subprocess.run([tmp_path / "main"], check=True)


@needs_compiler
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.long
@pytest.mark.parametrize("case", [*SMALL, "ur5 (5), sine"])
def test_every_option_is_refused_or_survived(case, compiler, in_c_of):
    """With others, too, no number that is not finite gets through, and torques are the same."""
    _, folder = in_c_of(case)
    # of the small one clang is asked what gcc knows nothing of
    few = case in SMALL and compiler == "clang"
    for options in OPTIONS[3:13] if few else OPTIONS:
        command = [compiler, "-Werror", *options.split(), "-E", "-x", "c", "/dev/null"]
        if subprocess.run(command, capture_output=True).returncode:
            continue  # which this compiler does not have
        if is_refused(folder, compiler, options):
            assert "fast" in options or "math" in options
            continue
        made = self_test(folder, compiler, f"-O1 {options}")
        if "see REFUSED_BUILD" in made.stdout:
            assert compiler == "clang", options
            assert "math" in options or "nans" in options
            continue
        assert "not refused" not in made.stdout, options
        assert float(made.stdout.split()[-1]) < 1e-11, options


@needs_compiler
@pytest.mark.parametrize(
    ("case", "standard", "compiler"),
    [
        pytest.param(
            case, standard, k, marks=marks if k == "gcc" or not marks else pytest.mark.long
        )
        for case, standard, marks in (
            ("two_link", "c++11", ()),  # by clang, too; larger ones and c++17 in CI by gcc only
            ("two_link", "c++17", pytest.mark.study),
            *((each, "c++11", pytest.mark.study) for each in IN_CPP),
            *((each, "c++11", pytest.mark.long) for each in CASES if each not in IN_CPP),
            *((each, "c++17", pytest.mark.long) for each in CASES),
        )
        for k in COMPILERS
    ],
)
def test_it_is_cpp_too(case, standard, compiler, tmp_path):
    name = OF_C_AND_CPP[compiler]
    if shutil.which(name) is None:
        pytest.skip(f"no {name} here")
    known = case in CASES
    aj.export_c(built(case)[0] if known else law_6(aj.load_robot("two_link")), tmp_path)
    strict = [f"-std={standard}", "-x", "c++", *STRICT[1:], EXACT, "-O1"]
    command = [name, *strict, "controller.c", "selftest.c", "-o", "selftest", "-lm"]
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr[:2000]
    subprocess.run([tmp_path / "selftest"], check=True, stdout=subprocess.DEVNULL)


@needs_compiler
@pytest.mark.parametrize(
    "level",
    [
        "-O1",
        *(pytest.param(each, marks=pytest.mark.study) for each in ("-O0", "-O2", "-O3", "-Os")),
    ],
)
def test_a_law_without_a_state_is_compiled_without_a_warning(level, tmp_path):
    aj.export_c(built("panda (6)")[0].guarded(None), tmp_path)
    assert header_number(tmp_path, "N_STATE") == 0
    compiled(tmp_path, level, "-Wconversion", "-Wshadow", "-c", "-o", "controller.o")


def steps_to_the_bit(folder, level):
    """Number of steps that C's self test finds to the bit, and of all; −1 of one that fails."""
    made = self_test(folder, COMPILERS[0], level)
    same, count = re.match(r"(\d+) of (\d+) steps to the bit", made.stdout).groups()
    return -1 if made.returncode else int(same), int(count)


@needs_compiler
@pytest.mark.study
@pytest.mark.parametrize("arm", SEVERAL, indirect=True)
def test_the_self_test_passes_for_every_arm(arm, tmp_path):
    law = law_6(arm)
    aj.export_c(limited(law, 1.0) if np.isfinite(arm.effort_limits).all() else law, tmp_path)
    same, count = steps_to_the_bit(tmp_path, "-O0")
    assert same == count > 0


@needs_compiler
def test_the_self_test_passes_where_the_camera_does_not_see_every_configuration(tmp_path):
    arm = aj.load_robot("two_link")
    beside = aj.PinholeCamera.looking_at((2.0, 0.0, 0.3), (0.2, 0.1, 0.0), 600.0, (640, 480))
    task = aj.ImageTask(arm, beside)
    aj.export_c(aj.SetpointController(task, velocity=DifferentiatedVelocity()), tmp_path)
    same, count = steps_to_the_bit(tmp_path, "-O1")
    assert same == count > 0


@needs_compiler
def test_the_self_test_passes_for_a_law_of_ones_own_that_has_no_torque_without_x(panda, tmp_path):
    aj.export_c(Springs(aj.PositionTask(panda)), tmp_path)
    same, count = steps_to_the_bit(tmp_path, "-O1")
    assert same == count > 0


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm here")
@pytest.mark.parametrize(
    "case",
    ["panda (6), limits", pytest.param("kinova (5), (29)", marks=pytest.mark.study)],
)
def test_it_needs_no_heap_and_little_of_libm(case, in_c_of):
    _, folder = in_c_of(case)
    compiled(folder, "-O0", "-fno-builtin", "-c", "-o", "controller.o")
    lines = subprocess.run(
        ["nm", "controller.o"], cwd=folder, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    symbols = {kind: {line.split()[-1] for line in lines if f" {kind} " in line} for kind in "UBDT"}
    assert symbols["U"] <= {"sqrt", "fabs", "_GLOBAL_OFFSET_TABLE_", "memset", "memcpy"}
    assert symbols["B"] == symbols["D"] == set()  # no variables: re-entrant
    prefix = case.split()[0]
    assert symbols["T"] == {f"{prefix}_init", f"{prefix}_step"}


@needs_compiler
@pytest.mark.study
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake here")
def test_cmake_builds_it_and_runs_the_self_test(tmp_path):
    aj.export_c(built("panda (6)")[0], tmp_path)
    for command in (
        ["cmake", "-B", "build", "."],
        ["cmake", "--build", "build"],
        ["ctest", "--test-dir", "build"],
    ):
        made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert made.returncode == 0, made.stdout + made.stderr


@needs_compiler
@pytest.mark.study
def test_what_is_no_number_is_refused_with_a_safe_torque(in_c_of):
    """Whichever entry it is; and whatever is refused, the state stays to the bit."""
    _, step = built("panda (28), limits, away from stops")
    in_c, folder = in_c_of("panda (28), limits, away from stops")
    given = draws(step, 5, seed=3)
    row = {name: given[name][2].copy() for name in INPUTS} | {"dt": 1e-3}
    row["state"] = step.initial_state(Measurement(0.0, row["q"], row["v"], row["x"]))

    def refused(name, why=None, **changes):
        """Return torque and answer of a step of which some argument is changed."""
        wrong = row | changes
        status, after, found = in_c.step(*wrong.values())
        assert status == header_number(folder, f"REFUSED_{(why or name).upper()}")
        assert after.tobytes() == np.asarray(wrong["state"]).tobytes() or why == "target"
        assert np.isfinite(found["torque"]).all()
        return found

    def refused_for_good(name, why=None, **changes):
        found = refused(name, why, **changes)
        assert not any(found[each].any() for each in found if each != "status")

    lost = in_c.step(*{**row, "x": np.full(3, np.nan)}.values())
    for place, value in itertools.product((0, -1), (np.nan, np.inf, -np.inf)):
        for name in ("q", "v", "state"):
            refused_for_good(name, **{name: entry(row[name], place, value)})
        found = refused("target", "target", target=entry(row["target"], place, value))
        assert found["torque"].tobytes() == lost[2]["torque"].tobytes()
    usual = in_c.step(*row.values())[2]["torque"]
    for value in (np.nan, np.inf, -np.inf, 0.0, -1e-3):
        assert refused("dt", dt=value)["torque"].tobytes() == usual.tobytes()
    for place, value in itertools.product((0, -1), (1.1e6, -1.1e6)):
        refused_for_good("q", q=entry(row["q"], place, value))
    for name in ("v", "state"):
        refused_for_good(name, "overflow", **{name: np.full(len(row[name]), 1e308)})


@needs_compiler
def test_a_next_state_that_overflows_alone_is_refused(in_c_of):
    """Where gravity is learnt; elsewhere dt is of no effect on the torque."""
    _, step = built("panda (28), limits, away from stops")
    in_c, folder = in_c_of("panda (28), limits, away from stops")
    given, refused = draws(step, 20, seed=3, at_bounds=0.0), 0
    for row in zip(*(given[name] for name in INPUTS), strict=True):
        status, after, found = in_c.step(*row, 1e308)
        if status == header_number(folder, "REFUSED_OVERFLOW"):
            refused += 1
            assert after.tobytes() == row[0].tobytes()
            assert not any(found[name].any() for name in found if name != "status")
        else:
            assert status == in_c.step(*row, 1e-3)[0]
            assert np.isfinite(after).all()
    assert refused > 0


def bridged_motion(task, dt):
    """Samples of a motion with bad ones among them, which do not end: t, q, v, x, and status."""
    robot, rng = task.robot, np.random.default_rng(5)
    q, own = robot.random_configuration(rng), {"x": np.full(task.n_x, np.nan)}
    bad = {
        10: ("JOINTS_UNKNOWN", lambda now: now._replace(q=entry(now.q, -1, np.nan))),
        15: ("JOINTS_UNKNOWN", lambda now: now._replace(v=entry(now.v, 0, np.inf))),
        20: ("JOINTS_UNKNOWN", lambda now: now._replace(t=np.nan)),
        25: ("VELOCITY_JUMPED", lambda now: now._replace(v=now.v + 1e3)),
        30: ("JOINTS_UNKNOWN", lambda now: now._replace(v=np.full(robot.nv, 1e308))),
        35: ("CLOCK_JUMPED", lambda now: now._replace(t=now.t - dt)),
        40: ("SENSOR_JUMPED", lambda now: now._replace(x=now.x + 5.0)),
        45: (None, lambda now: now._replace(**own)),
    }
    for k in range(80):
        v = 0.3 * np.cos(np.arange(robot.nv) + k * dt)
        now, status = Measurement(k * dt, q, v, task.value(q) + 1e-4 * rng.normal(size=3)), None
        if k in bad:
            status, change = bad[k]
            now = change(now)
        elif k >= 60:
            now, status = now._replace(v=v + 1e3), "VELOCITY_JUMPED" if k < 65 else "STOPPED"
        yield now, status
        q = pin.integrate(robot.model, q, dt * v)


@needs_compiler
@pytest.mark.parametrize(
    "case",
    [
        "panda (6), limits",
        pytest.param("panda (28), limits, away from stops", marks=pytest.mark.study),
        pytest.param("kinova (5), (29)", marks=pytest.mark.study),
    ],
)
def test_bad_samples_are_bridged_as_in_python(case, in_c_of):
    """The statuses and torques of Python, the bits of NumPy, and what is learnt stays."""
    controller, step = built(case)
    in_c, function, task = in_c_of(case)[0], step.in_numpy(), controller.task
    state, before, was_bad = None, None, False
    for now, status in bridged_motion(task, 1e-3):
        t, q, v, x, _ = now
        if state is None:
            state, target = controller.initial_state(now), x + 0.01
        after, expected = controller.step(state, now, target, 1e-3)
        assert status in (None, expected.status.name)
        number, found, answer = in_c.step(state, q, v, x, target, 1e-3, t)
        assert number == expected.status
        scale = 1.0 + np.abs(expected.torque).max()
        np.testing.assert_allclose(answer["torque"] / scale, expected.torque / scale, atol=1e-9)
        np.testing.assert_allclose(found, after, rtol=1e-9, atol=1e-9)
        given = {"t": [t], "q": q, "v": v, "x": x, "t_x": [np.nan], "target": target}
        given |= {"state": state, "dt": [1e-3]}
        given |= {name: np.zeros(task.m) for name in ("target_v", "target_a")}
        of_numpy = function(**{name: np.reshape(each, (-1, 1)) for name, each in given.items()})
        assert found.tobytes() == of_numpy["after"][:, 0].tobytes()
        assert answer["torque"].tobytes() == of_numpy["torque"][:, 0].tobytes()
        if status not in (None, "STOPPED", "SENSOR_JUMPED"):
            assert was_bad or answer["torque"].tobytes() == before.tobytes()  # it is eased later
            np.testing.assert_array_equal(found[: controller.size], state[: controller.size])
        state, before, was_bad = found, answer["torque"], status is not None


@needs_compiler
def test_a_wrong_period_gets_the_torque_of_the_law_however_often(in_c_of):
    """Though the clock runs on meanwhile: nothing is bridged without a period."""
    case = "panda (28), limits, away from stops"
    (in_c, folder), controller = in_c_of(case), built(case)[0]
    motion = [now for now, _ in bridged_motion(controller.task, 1e-3)][:9]
    own = controller.size
    t, q, v, x, _ = motion[0]
    state, target = in_c.init(motion[0]), x + 0.01
    state = in_c.step(state, q, v, x, target, 1e-3, t)[1]
    for t, q, v, x, _ in motion[1:]:
        fresh = np.concatenate([state[:own], in_c.init(motion[0])[own:]])
        expected = in_c.step(fresh, q, v, x, target, 1e-3, t)[2]["torque"]
        for dt in (0.0, np.nan):
            status, after, answer = in_c.step(state, q, v, x, target, dt, t)
            assert status == header_number(folder, "REFUSED_DT")
            np.testing.assert_array_equal(after, state)
            np.testing.assert_array_equal(answer["torque"], expected)


def entry(array, place, value):
    changed = array.copy()
    changed[place] = value
    return changed


@needs_compiler
@pytest.mark.study
def test_continuous_joints_off_the_unit_circle_are_refused(in_c_of):
    controller, step = built("kinova (6), limits")
    (in_c, folder), given = in_c_of("kinova (6), limits"), draws(step, 3)
    state, q, *rest = (given[name][0] for name in INPUTS)
    pairs = [joint.idx_q for joint in controller.task.robot.model.joints[1:] if joint.nq == 2]
    for i, size in itertools.product(pairs, (1.0, 1.0009, 0.9991, 1.0011, 0.9989, 0.0, -1.0)):
        off = np.where((np.arange(len(q)) == i) | (np.arange(len(q)) == i + 1), size * q, q)
        status, _, found = in_c.step(state, off, *rest, 1e-3)
        if abs(abs(size) - 1.0) < 1e-3:
            assert status >= 0
        else:
            assert status == header_number(folder, "REFUSED_Q")
            assert not found["torque"].any()


@needs_compiler
def test_a_first_x_that_is_lost_starts_no_law_that_differentiates_it(in_c_of):
    for case, starts in (("ur5 (5), sine", False), ("kinova (6), limits", True)):
        controller, step = built(case)
        in_c, robot = in_c_of(case)[0], controller.task.robot
        first = Measurement(0.0, robot.neutral(), np.zeros(robot.nv), np.array([np.nan, 0.0, 0.0]))
        assert (in_c.init(first) is not None) == starts
        seen = first._replace(x=np.array([1.0, 0.0, 0.0]))
        assert in_c.init(seen).tobytes() == step.initial_state(seen).tobytes()
        np.testing.assert_allclose(in_c.init(seen), controller.initial_state(seen))


@needs_compiler
def test_with_a_rate_of_torque_it_begins_with_what_carries_the_arm(tmp_path):
    arm = aj.load_robot("two_link")
    law = aj.TorqueLimited(law_6(arm), aj.Limits(rate=10.0))
    in_c, (task, dt) = InC(law, tmp_path), (law.task, 1e-3)
    q, still = np.array([0.2, 0.5]), np.zeros(2)
    now, carried = Measurement(0.0, q, still, task.value(q)), law.gravity_torque(np.zeros(0), q)
    assert np.abs(carried).min() > 1.0
    target = now.x + 0.05
    _, _, answer = in_c.step(in_c.init(now), *now[1:4], target, dt)
    expected = law.step(law.initial_state(now), now, target, dt)[1]
    np.testing.assert_allclose(answer["torque"], expected.torque, atol=1e-9)
    np.testing.assert_allclose(np.abs(answer["torque"] - carried), 10.0 * dt)


def learning(arm):
    return aj.AdaptiveKinematics(aj.PositionTask(arm), unknown=("tool",))


def calibrated(arm):
    return aj.AdaptiveKinematics(aj.PositionTask(arm), ("tool",), prior=belief_of(arm)[0])


def tracking(arm, **options):
    return aj.TrackingController(aj.PositionTask(arm), kinematics=learning(arm), **options)


TIMED = {
    "tracking": lambda arm: limited(tracking(arm), 0.9),
    "velocity": lambda arm: tracking(arm, command="velocity"),
    "held": lambda arm: HeldMeasurement(law_6(arm), 0.02),
    "predicted": lambda arm: PredictedMeasurement(law_6(arm), learning(arm)),
    "prior": lambda arm: PredictedMeasurement(law_6(arm), calibrated(arm)),
}


@needs_compiler
@pytest.mark.parametrize("command", [pytest.param("torque", marks=pytest.mark.study), "velocity"])
def test_without_a_target_a_tracking_law_learns_nothing(command, tmp_path):
    """The joints come to rest; what is kept of time and frames is that of an x that is lost."""
    controller = tracking(aj.load_robot("two_link"), command=command)
    in_c, task = InC(controller, tmp_path), controller.task
    q, v, t = np.array([0.4, 0.9]), np.array([0.1, -0.2]), 0.0
    x, move = task.value(q), 1e-3 * v
    state = controller.initial_state(Measurement(t, q, v, x, t))
    for _ in range(30):  # of one image; the next one is 1 cm beside
        state = in_c.step(state, q, v, x, x, 1e-3, t, 0.0)[1]
        t, q = t + 1e-3, q + move
    p, end = controller.resting, controller.resting + controller.kinematics.n_state
    nowhere, lost = np.full(2, np.nan), np.full(2, np.nan)
    status, after, answer = in_c.step(state, q, v, x + 0.01, nowhere, 1e-3, t, t)
    assert status == header_number(tmp_path, "REFUSED_TARGET")
    expected, _ = controller.step(state, Measurement(t, q, v, lost, t), x, 1e-3)
    np.testing.assert_array_equal(after[:p], state[:p])
    np.testing.assert_allclose(after[p:end], expected[p:end], rtol=1e-12, atol=1e-12)
    seen = controller.step(state, Measurement(t, q, v, x + 0.01, t), x, 1e-3)[0]
    assert np.abs(seen[p:end] - after[p:end]).max() > 1e-6
    assert np.isfinite(answer["torque"]).all()


@needs_compiler
@pytest.mark.parametrize(
    "case",
    [k if k == "held" else pytest.param(k, marks=pytest.mark.study) for k in TIMED],
)
def test_what_depends_on_time_is_that_of_python(case, panda, tmp_path):
    """A moving target, and a camera of 50 Hz, 20 ms late, that loses x for a while."""
    controller = TIMED[case](panda.with_object(0.0))
    in_c, truth = InC(controller, tmp_path), aj.PositionTask(panda.with_object(0.1))
    start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    motion = np.array([0.2, 0.3, -0.2, 0.3, 0.1, -0.2, 0.3])

    def measured(k):
        t, t_x = 1e-3 * k, 0.02 * (k // 20) - 0.02
        q, then = (start + np.sin(each) * motion for each in (t, t_x))
        x = truth.value(then) if not 100 <= k < 160 else np.full(3, np.nan)
        return Measurement(t, q, np.cos(t) * motion, x, t_x)

    state, seen = controller.initial_state(measured(0)), set()
    np.testing.assert_allclose(in_c.init(measured(0)), state, rtol=1e-12, atol=1e-12)
    turn = aj.Circle(center=truth.value(start), radius=0.05, period=2.0)
    for k in range(250):
        now = measured(k)
        target = turn.at(now.t) if case in ("tracking", "velocity") else turn.at(0.0).x
        after, expected = controller.step(state, now, target, 1e-3)
        t, q, v, x, t_x = now
        status, found, answer = in_c.step(state, q, v, x, target, 1e-3, t, t_x)
        assert status == expected.status
        scale = 1.0 + np.abs(expected.torque).max()
        np.testing.assert_allclose(answer["torque"] / scale, expected.torque / scale, atol=1e-9)
        np.testing.assert_allclose(found, after, rtol=1e-9, atol=1e-9)
        state = after
        seen.add(expected.status.name)
    assert len(seen) > 1
    x = truth.value(start)  # anything that is known: whether it is new depends on its time
    for t_x in (-np.inf, None, now.t, -np.inf):
        later = now._replace(t=now.t + 1e-3, x=x, t_x=t_x)
        after, expected = controller.step(state, later, target, 1e-3)
        status, found, answer = in_c.step(state, *later[1:4], target, 1e-3, later.t, t_x)
        assert status == expected.status
        np.testing.assert_allclose(found, after, rtol=1e-9, atol=1e-9)
        first = in_c.init(later._replace(t_x=t_x))
        np.testing.assert_allclose(first, controller.initial_state(later), rtol=1e-12, atol=1e-12)
    begun = in_c.init(now)
    for t, t_x in ((np.nan, 0.0), (np.inf, 0.0), (-np.inf, -1.0), (1.0, np.inf), (1.0, 2.001)):
        status, found, answer = in_c.step(begun, q, v, x, target, 1e-3, t, t_x)
        assert status == header_number(tmp_path, "REFUSED_T")
        assert not answer["torque"].any()
        np.testing.assert_array_equal(found, begun)
        status, found, answer = in_c.step(state, q, v, x, target, 1e-3, t, t_x)
        assert STATUSES[status] in (aj.Status.JOINTS_UNKNOWN, aj.Status.CLOCK_JUMPED)
        assert answer["torque"].any()
        np.testing.assert_array_equal(found[: controller.size], state[: controller.size])
    assert in_c.step(begun, q, v, x, target, 1e-3, 1.0, 1.999)[0] >= 0
    if case in ("tracking", "velocity"):  # the others ask for no rates
        whole = in_c.step(state, q, v, x, np.full(3, np.nan), 1e-3, now.t, now.t)
        assert whole[0] == header_number(tmp_path, "REFUSED_TARGET")
        assert np.isfinite(whole[2]["torque"]).all()
        for name, place in itertools.product("xva", (0, -1)):
            wrong = entry(getattr(target, name), place, np.inf)
            found = in_c.step(state, q, v, x, target._replace(**{name: wrong}), 1e-3, now.t, now.t)
            assert found[0] == whole[0]
            np.testing.assert_array_equal(found[1], whole[1])
            np.testing.assert_array_equal(found[2]["torque"], whole[2]["torque"])


def test_the_header_says_what_it_was_made_from(tmp_path):
    controller, _ = built("panda (28), limits, away from stops")
    folder = aj.export_c(controller, tmp_path / "new" / "folder")
    assert sorted(each.name for each in folder.iterdir()) == sorted(NAMES)
    header = (folder / "controller.h").read_text(encoding="utf-8")
    law = controller.controller
    for text in (
        f"approxjac {aj.__version__}", "robot    panda", ", ".join(
            f"panda_joint{i} [rad]" for i in (1, 2, 3)
        ),
        "PositionTask('panda', 'panda_hand_tcp', 'xyz'), x in m", "law (28)",
        f"K_p {law.diagonals.kp[0]:.4g}", f"{law.saturation.gamma[0]:.4g}", "12 parameters",
        "AwayFromStops(share=0.12)", "Limits(effort=[34.8",
        "joint positions [rad]", "time for which the torque is held [s]",
        "/* the law was evaluated as written */\n    PANDA_OK = 0",
        "PANDA_LIMITS_PROOF_GIVEN_UP = 4",
    ):  # fmt: skip
        assert text in header
    for each in folder.iterdir():
        text = each.read_text(encoding="utf-8")
        assert str(tmp_path) not in text
        assert max(map(len, text.splitlines())) <= 100 or each.name == "selftest.c"


def test_lines_of_equations_name_their_functions(tmp_path):
    controller, _ = built("panda (28), limits, away from stops")
    text = (aj.export_c(controller, tmp_path) / "controller.c").read_text(encoding="utf-8")
    named = set(re.findall(r"= .*; /\* law\.(\w+) \*/", text))
    assert named >= {"measured_velocity_torque", "gravity", "passive_output", "theta_hat_rate"}
    for name in named:
        assert "Implements" in getattr(aj.law, name).__doc__


@needs_compiler
def test_the_same_controller_makes_the_same_files(tmp_path, in_c_of):
    _, one = in_c_of("panda (6), limits")
    other = aj.export_c(built("panda (6), limits")[0], tmp_path)
    for name in NAMES:
        text = (one / name).read_text("utf-8")
        assert text == (other / name).read_text("utf-8")
        assert max(map(len, text.splitlines())) <= 100 or name == "selftest.c"


def test_what_is_not_covered_is_refused_by_name(tmp_path):
    class Own(aj.PositionTask):
        def jacobian(self, q, x=None):
            return -super().jacobian(q) if q[0] > 7.0 else super().jacobian(q)

    arm = aj.load_robot("panda")
    law = law_6(arm)
    for controller, text in (
        (aj.TorqueLimited(law, solver=min), "solver must be None .* got <built-in function min>"),
        (
            aj.SetpointController(Own(arm)),
            "which Own.jacobian does not: TypeError: no branch",
        ),
    ):
        with pytest.raises(aj.InvalidInputError, match=text):
            aj.export_c(controller, tmp_path / "none")
    assert not (tmp_path / "none").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(aj.InvalidInputError, match="folder must be a folder, got 3"):
        aj.export_c(law, 3)
    (tmp_path / "taken" / "controller.c").mkdir(parents=True)
    for folder in ("file/none", "no\0name", "taken"):
        with pytest.raises(aj.InvalidInputError, match="folder must be one that can be made"):
            aj.export_c(law, tmp_path / folder)
