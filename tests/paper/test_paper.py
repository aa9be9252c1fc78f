"""The reproduction contract: THEORY.md, section 4. Figure 1 is Eq. (23), Eq. (24), Eq. (25)."""

import dataclasses
import inspect
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cli import paper_command
from approxjac.paper import experiments as paper
from approxjac.paper import verdicts
from approxjac.robots import Dynamics

# figure: max Re λ, ‖e‖/‖e(0)‖ at 5, 20, 60, 120 s, verdict, as THEORY.md prints them
TABLE = {
    3: ("+0.0588", ("0.508", "1.259", "1.685", "1.570"), "unstable"),
    4: ("-0.0920", ("0.552", "0.125", "0.0034", "0.000"), "stable"),
    5: ("-0.0130", ("0.737", "0.737", "0.530", "0.294"), "stable"),
    6: ("-0.1276", ("0.272", "0.008", "0.0002", "0.000"), "stable"),
    7: ("-0.0680", ("0.737", "0.246", "0.017", "0.0003"), "stable"),
}


def to_digits(value, printed):
    """Whether the value prints like that."""
    sign = "+" if printed[0] in "+-" else ""
    return f"{value:{sign}.{len(printed.split('.')[1])}f}" == printed


@pytest.fixture(scope="module")
def results():
    return {f: paper.run_experiment(e) for f, e in paper.EXPERIMENTS.items()}


@pytest.mark.parametrize("figure", TABLE)
def test_the_table_to_its_printed_digits(results, figure):
    eigenvalue, ratios, verdict = TABLE[figure]
    result = results[figure]
    assert to_digits(result.local.max_real_eigenvalue, eigenvalue)
    for t, printed in zip(paper.REPORT_TIMES, ratios, strict=True):
        assert to_digits(result.error_ratios[t], printed)
    assert result.verdict == verdict
    assert result.agrees_with_paper


def test_figure_8(results):
    result = results[8]
    assert result.verdict == "stable"
    assert result.agrees_with_paper
    assert to_digits(result.local.max_real_eigenvalue, "-0.0833")
    assert_allclose(result.theta_hat, [3.5, 1.625], rtol=0.01)
    assert_allclose(result.run.state[0], [0.0, 0.0])
    ratio = result.run.error_norm / result.run.error_norm[0]
    assert ratio.max() > 2.0
    assert to_digits(result.error_ratios[60.0], "0.03")
    assert to_digits(result.error_ratios[120.0], "0.0001")


def test_the_page_of_the_study_has_the_numbers_of_the_code():
    page = (Path(__file__).parents[2] / "docs" / "studies" / "paper.md").read_text(encoding="utf-8")

    def row(name, kp, kv, camera, lengths, gravity):
        roll = f"{math.degrees(camera.roll):g}°"
        sizes = ", ".join(f"{length:g}" for length in lengths)
        seen = f"{camera.focal_length:g}", f"{camera.distance:g}", roll
        cells = name, kp, kv, *seen, sizes, gravity
        return "".join(f"| {cell} " if cell else "| " for cell in cells) + "|"

    learnt = f"learnt, L = {paper.LEARNING_GAIN:g} I, α = {paper.ALPHA:g}, θ̂(0) = 0"
    rows = [row("true", "", "", paper.CAMERA, paper.LENGTHS, "")]
    for figure, e in paper.EXPERIMENTS.items():
        gravity = learnt if e.learn_gravity else "known"
        rows.append(row(f"{figure}", f"{e.kp:g}", f"{e.kv:g}", e.camera, e.lengths, gravity))
    assert "\n".join(rows) in page
    start, target = (f"({a:g}°, {b:g}°)" for a, b in np.degrees([paper.START, paper.TARGET]))
    assert f"starts at rest in q(0) = {start}; its target is the image of {target}" in page
    duration = inspect.signature(paper_command.paper).parameters["duration"].default
    assert f"each run lasts {duration:g} s" in page


def test_V_is_no_lyapunov_function_where_theorem_1_does_not_hold(results):
    assert results[3].run.V.min() < -6.0
    assert results[4].run.V.min() > 0.0


def test_every_run_starts_where_the_contract_says(results):
    for result in results.values():
        run = result.run
        assert_allclose(run.q[0], np.radians([60.0, 90.0]))
        assert_allclose(run.v[0], 0.0)
        # X_d = camera(h(90°, 90°)) = f/(z − f) (−1.5, 1)
        assert_allclose(run.target, 0.05 / 2.95 * np.array([-1.5, 1.0]), atol=1e-15)


PITCH = 1e-5  # metres a pixel


def pinhole(planar):
    """A camera with the same image of the arm's plane in pixels, the origin in the middle."""
    size = np.array([20000, 20000])
    camera = aj.PinholeCamera(
        planar.focal_length / PITCH,
        size,
        (0.0, planar.distance - planar.focal_length, 0.0),
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T,  # right, down, forward
        center=np.array(planar.offset) / PITCH + (size - 1) / 2,
    )
    return camera.recalibrated({"roll": planar.roll})


@pytest.mark.parametrize(
    "figure",
    [pytest.param(n, marks=[] if n == 4 else pytest.mark.long) for n in paper.EXPERIMENTS],
)
def test_a_pinhole_camera_gives_the_same_numbers(results, figure):
    """Section 5.1 through the general code: gains are those of an error in px, runs the same."""
    experiment, planar = paper.EXPERIMENTS[figure], results[figure].run
    plant, controller = paper.build(experiment)
    sensor = aj.ImageTask(plant.robot, pinhole(paper.CAMERA))
    plant = aj.Plant(plant.robot, sensor)
    controller = aj.SetpointController(
        aj.ImageTask(controller.task.robot, pinhole(experiment.camera)),
        aj.Gains(experiment.kp * PITCH**2, experiment.kv * PITCH**2),
        gravity=controller.gravity,
    )
    q_target = np.array(paper.TARGET)
    local = aj.local_stability(plant, controller, q_target)
    assert_allclose(local.max_real_eigenvalue, results[figure].local.max_real_eigenvalue)
    run = aj.simulate(
        plant, controller, sensor.value(q_target), paper.START, 20.0, record_every=0.025, dt=None
    )
    n = len(run.t)
    assert_allclose(run.t, planar.t[:n], atol=1e-9)
    for found, known in (
        (PITCH * run.error, planar.error), (run.q, planar.q), (run.tau, planar.tau),
        (run.state, planar.state),
    ):  # fmt: skip
        assert_allclose(found, known[:n], rtol=0, atol=1e-6 * np.abs(known[:n]).max(initial=0.0))


def test_a_verdict_needs_linearization_and_run(results):
    stable, unstable = results[4], results[3]
    mixed = paper.Reproduction(stable.experiment, unstable.run, stable.local, None)
    assert mixed.verdict == "unstable"
    assert "they differ" in mixed.reason
    assert not mixed.agrees_with_paper
    mixed = paper.Reproduction(stable.experiment, stable.run, unstable.local, None)
    assert mixed.verdict == "unstable"
    assert paper.Reproduction(stable.experiment, stable.run, stable.local, None).verdict == "stable"


FALLING = np.exp(-0.05 * np.arange(80.0))


@pytest.mark.parametrize(
    ("norm", "settles"),
    [
        (FALLING, True),
        (np.exp(-1e-3 * np.arange(80.0)), False),  # by 2 % in a quarter
        (np.append(FALLING[:70], np.full(10, 1.5 * FALLING[65])), False),  # and rises at the end
        (np.append(1.0, 9.0 * FALLING[1:20].repeat(5)[:79]), False),  # but not below its start
        (np.append(FALLING[:60], np.linspace(0.0, 9e-7, 20)), True),  # what is all but gone
        (np.append(FALLING[:60], np.linspace(0.0, 2e-6, 20)), False),
    ],
)
def test_an_error_has_died_down_where_each_part_of_its_end_says_so(usual, norm, settles):
    error = np.outer(norm, [0.6, -0.8])
    run = dataclasses.replace(usual.run, t=np.arange(80.0), error=error)
    assert dataclasses.replace(usual, run=run).settles == settles


def test_an_arm_that_is_believed_as_it_is_has_the_inertia_of_the_true_one(rng):
    """Of Figures 3 to 5 the camera alone is wrong; no joint has friction."""
    plant, controller = paper.build(paper.EXPERIMENTS[4])
    belief = Dynamics(controller.task.robot)
    for q in rng.uniform(-3.0, 3.0, (3, 2)):
        assert_allclose(belief.M(q), plant.dynamics.M(q))
        assert_allclose(belief.g(q), plant.dynamics.g(q), atol=1e-12)
        assert_allclose(controller.gravity.torque(q), plant.dynamics.g(q), atol=1e-12)
    assert_allclose(plant.friction, [0.0, 0.0])


@pytest.mark.long
def test_a_limit_cycle_is_not_called_stable(monkeypatch):
    """A large start makes any early quarter look worse than a limit cycle that goes on."""
    monkeypatch.setattr(paper, "START", (math.radians(200.0), math.radians(-170.0)))
    monkeypatch.setattr(paper, "TARGET", (math.radians(-30.0), math.radians(45.0)))
    result = paper.run_experiment(paper.EXPERIMENTS[8])
    assert result.error_ratios[120.0] > 0.01
    assert result.verdict == "unstable"


@pytest.mark.study
def test_learnt_gravity_needs_the_linearization_too(monkeypatch):
    """The run of Figure 8 dies down at the other elbow; at the posture meant it would grow."""
    monkeypatch.setattr(paper, "TARGET", (math.radians(45.0), math.radians(90.0)))
    result = paper.run_experiment(paper.EXPERIMENTS[8])
    assert result.settles
    assert not result.local.stable
    assert result.verdict == "unstable"
    assert result.reason.endswith("or end elsewhere than at the target")


def test_a_run_that_is_too_short_says_so():
    result = paper.run_experiment(paper.EXPERIMENTS[3], 1.0)
    assert result.verdict == "unstable"
    assert not result.evidence_agrees
    assert "too short to show the growth" in result.reason


def test_figure_1_bounds_figure_4():
    bound = paper.jacobian_bound()
    assert bound.largest_allowed_p == pytest.approx(0.0113, abs=5e-5)
    assert bound.p_of_figure_4 == pytest.approx(0.0381, abs=5e-5)
    assert bound.alpha == pytest.approx(math.sqrt(bound.lambda_2))
    # at a = 0.5, the best over all α is found by trying them
    alphas = np.geomspace(1e-6, 1.0, 20001)
    tried = np.minimum(2 * bound.lambda_2 / (0.5 + alphas), 2 * 0.5 * alphas / (0.5 + alphas))
    assert bound.allowed_p_at_a_of_figure_4 == pytest.approx(tried.max(), rel=1e-3)
    assert bound.allowed_p_at_a_of_figure_4 < bound.largest_allowed_p < bound.p_of_figure_4
    assert not bound.condition_23_met


def test_the_summary_and_the_table_are_of_what_was_run(results):
    """Each figure by its own numbers, whichever are asked for and in whichever order."""
    bound = paper.jacobian_bound()
    summary = verdicts.summary([results[f] for f in (8, 3, 6)], bound, 120.0)
    figures = summary["figures"]
    assert list(figures) == ["fig1", "fig8", "fig3", "fig6"]
    setup = {"start": paper.START, "target": paper.TARGET, "duration": 120.0}
    assert summary["setup"] == setup
    for figure in (3, 6, 8):
        found, result = figures[f"fig{figure}"], results[figure]
        own = paper.EXPERIMENTS[figure]
        assert (found["kp"], found["kv"], found["paper"]) == (own.kp, own.kv, own.paper_says)
        assert found["believed"]["lengths"] == own.lengths
        for name in ("focal_length", "distance", "roll"):
            assert found["believed"]["camera"][name] == getattr(own.camera, name)
            assert summary["truth"]["camera"][name] == getattr(paper.CAMERA, name)
        assert found["max_real_eigenvalue"] == result.local.max_real_eigenvalue
        assert found["error_ratio"] == {f"{t:g}": r for t, r in result.error_ratios.items()}
        assert (found["verdict"], found["agrees_with_paper"]) == (result.verdict, True)
        assert (found["gravity"] == "known") == ("theta_hat" not in found) == (figure != 8)
    assert figures["fig8"]["theta_hat"] == results[8].theta_hat.tolist()
    for name, value in dataclasses.asdict(bound).items():
        assert figures["fig1"][name] == value
    lines = verdicts.table([results[3], results[8]], bound).splitlines()
    assert lines[0] == "verdicts: 2 of 2 as in the paper"
    row = next(line for line in lines if line.startswith("3 ")).split()
    printed = [f"{r:.4f}" for r in results[3].error_ratios.values()]
    assert row[-8:] == [*printed, "unstable", "“an", "unstable", "response”"]
    wrong = dataclasses.replace(results[3], experiment=paper.EXPERIMENTS[4])
    told = verdicts.table([wrong, results[8]], None)
    assert told.startswith("verdicts: 1 of 2 as in the paper")
    assert "(differs)" in told
    assert f"Figure 4: {wrong.reason}" in " ".join(told.split())


@pytest.mark.study
def test_error_ratios_do_not_depend_on_the_duration():
    usual = paper.run_experiment(paper.EXPERIMENTS[4], 20.0)
    odd = paper.run_experiment(paper.EXPERIMENTS[4], 77.7)
    for t in (5.0, 20.0):
        assert odd.error_ratios[t] == pytest.approx(usual.error_ratios[t], rel=1e-3)


@pytest.fixture(scope="module")
def usual():
    return paper.run_experiment(paper.EXPERIMENTS[4], 2.0)


@pytest.mark.parametrize("larger", [1.0, 3.0])
def test_figure_1_is_of_the_bound_that_it_is_given(larger, tmp_path, monkeypatch):
    """Both curves of (23) through their crossing, and Figure 4's own p."""
    drawn = []
    monkeypatch.setattr(verdicts.view, "save_figure", lambda figure, stem: drawn.append(figure))
    bound = paper.jacobian_bound()
    bound = dataclasses.replace(bound, lambda_2=larger * bound.lambda_2)
    verdicts.write_bound(bound, tmp_path)
    (ax,) = drawn[0].axes
    velocity, position, crossing, own = ax.lines
    alpha = math.sqrt(bound.lambda_2)
    assert_allclose(np.ravel(crossing.get_data()), [alpha, alpha])
    for line, numerator in ((velocity, lambda a: bound.lambda_2), (position, lambda a: a * alpha)):
        a, p = line.get_data()
        assert_allclose(p, 2.0 * numerator(a) / (a + alpha))
    assert_allclose(own.get_ydata(), bound.p_of_figure_4)


@pytest.mark.study
def test_the_cross_in_a_figure_is_where_the_target_has_the_tip(usual, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(verdicts.view, "save_figure", lambda figure, stem: drawn.append(figure))
    truth = paper.build_arm()
    verdicts.write_result(usual, truth, tmp_path)
    lines = {line.get_label(): np.array(line.get_data()).T for line in drawn[0].axes[1].lines}
    (l1, l2, lo), (q1, q2) = paper.LENGTHS, paper.TARGET
    tip = l1 * np.exp(1j * q1) + (l2 + lo) * np.exp(1j * (q1 + q2))
    assert_allclose(lines["target"], [[tip.real, tip.imag]], atol=1e-12)
    start = l1 * np.exp(1j * paper.START[0]) + (l2 + lo) * np.exp(1j * sum(paper.START))
    assert_allclose(lines["path of object_tip"][0], [start.real, start.imag], atol=1e-12)
    assert aj.Trajectory.load(tmp_path / "fig4.npz").t[-1] == 2.0
