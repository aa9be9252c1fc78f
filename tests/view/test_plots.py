import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import view
from approxjac.view.style import formulas


@pytest.fixture(scope="module")
def run():
    robot = aj.load_robot("two_link")
    task = aj.PositionTask(robot, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(60.0, 20.0))
    return aj.simulate(aj.Plant(robot, task), controller, (0.5, 1.2), (0.3, 0.8), 1.0, dt=None)


def test_the_error_is_drawn_in_millimetres(run):
    ax = view.plot_error(run)
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert_allclose(lines["x"].get_ydata(), 1e3 * run.error[:, 0])
    assert_allclose(lines["z"].get_xdata(), run.t)
    assert ax.get_ylabel() == "$x - x_d$ [mm]"
    assert ax.get_xlabel() == "time [s]"


def test_the_torque_of_each_joint_is_drawn(run):
    ax = view.plot_torque(run)
    assert [line.get_label() for line in ax.get_lines()] == ["joint1", "joint2"]
    assert_allclose(ax.get_lines()[1].get_ydata(), run.tau[:, 1])
    assert ax.get_ylabel() == r"$\tau$ [N m]"


def test_each_torque_is_drawn_as_the_share_of_its_own_limit(run):
    """To both sides, as lines of limits are; without a line where none is known."""
    ax = view.plot_torque(run, limits=np.array([20.0, 5.0]))
    lines = {line.get_label(): line.get_ydata() for line in ax.get_lines()}
    assert_allclose(lines["joint1"], run.tau[:, 0] / 20.0)
    assert_allclose(lines["joint2"], run.tau[:, 1] / 5.0)
    levels = [line.get_ydata()[0] for line in ax.get_lines() if len(set(line.get_ydata())) == 1]
    assert sorted(levels) == [-1.0, 1.0]
    ax = view.plot_torque(run, limits=np.array([np.inf, 5.0]))
    lines = {line.get_label(): line.get_ydata() for line in ax.get_lines()}
    assert np.isnan(lines["joint1"]).all()
    assert_allclose(lines["joint2"], run.tau[:, 1] / 5.0)


def test_shares_are_drawn_over_their_own_parameter():
    """x along the axis of x: values, what belongs to them, the controller's own, and scales."""
    x, y = np.array([0.1, 1.0, 10.0]), np.array([2.0, 4.0])
    shares = np.array([[0.1, 0.2, 0.3], [0.4, np.nan, 0.6]])  # by y, and then by x
    ax = view.plot_shares(x, y, shares, labels=("a", "kv"), own=(0.7, 3.0))
    (star,) = (line for line in ax.get_lines() if line.get_label() == "as given")
    assert (list(star.get_xdata()), list(star.get_ydata())) == ([0.7], [3.0])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("a", "kv")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "linear")
    (mesh,) = ax.collections
    shown = mesh.get_array().reshape(shares.shape)
    assert_allclose(shown.filled(np.nan), shares)
    assert mesh.get_clim() == (0.0, 1.0)
    across = mesh.get_coordinates()[0, :, 0]
    assert all(low < value < high for low, value, high in zip(across, x, across[1:], strict=False))


def test_the_path_is_that_of_the_true_tip(run):
    robot = aj.load_robot("two_link")
    ax = view.plot_path(run, robot)
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert_allclose(np.array(lines["path of tool0"].get_data()).T, run.x, atol=1e-12)
    start = np.array(lines["start"].get_data()).T
    elbow = [np.cos(0.3), np.sin(0.3)]
    assert_allclose(start[-1], run.x[0], atol=1e-12)
    assert any(np.allclose(point, elbow) for point in start)
    assert ax.get_aspect() == 1.0


def test_the_slack_is_drawn_with_what_limits_did(run):
    n = len(run.t)
    status = np.full(n, int(aj.LimitStatus.FREE))
    status[:50] = aj.LimitStatus.PROOF_GIVEN_UP
    slack = np.where(np.arange(n) < 50, 3.0, 0.0)
    ax = view.plot_slack(dataclasses.replace(run, limit_status=status, slack=slack))
    assert_allclose(ax.get_lines()[0].get_ydata(), slack)
    assert ax.get_ylabel() == r"$\sigma$ [W]"
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["FREE", "PROOF_GIVEN_UP"]
    given_up = ax.collections[1].get_paths()[0].get_extents()
    assert_allclose((given_up.x0, given_up.x1), (run.t[0], run.t[50]))


def test_a_slack_that_is_not_known_has_no_line(run):
    ax = view.plot_slack(dataclasses.replace(run, slack=np.full(len(run.t), np.nan)))
    assert ax.get_ylim() == (0.0, 1.0)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["UNLIMITED"]


def test_a_run_is_drawn_in_two_plots(run):
    figure, axes = view.plot_run(run)
    assert figure.axes == axes
    assert [ax.get_ylabel() for ax in axes] == ["$x - x_d$ [mm]", r"$\tau$ [N m]"]


def test_pictures_are_written_and_repeat_to_the_byte(run, tmp_path):
    paths = view.save_figure(view.plot_error(run).figure, tmp_path / "run")
    assert [path.name for path in paths] == ["run.png", "run.svg"]
    again = view.save_figure(view.plot_error(run).figure, tmp_path / "again.png")
    assert [path.name for path in again] == ["again.png", "again.svg"]  # no ending is doubled
    for a, b in zip(paths, again, strict=True):
        assert a.read_bytes() == b.read_bytes()
    with pytest.raises(aj.InvalidInputError, match="stem must name files that can be written, got"):
        view.save_figure(Figure(), tmp_path / "nowhere" / "run")


def test_a_plot_over_time_begins_with_the_run(run):
    late = dataclasses.replace(run, t=run.t + 5.0)
    for plot in (view.plot_error, view.plot_torque, view.plot_slack):
        assert plot(late).get_xlim() == (late.t[0], late.t[-1])


def test_symbols_with_an_index_are_formulas():
    assert formulas("K_v too small, x_s [mm]") == "$K_{v}$ too small, $x_{s}$ [mm]"
    for text in ("panda_joint1", "object_tip", "$x_d$", "x"):
        assert formulas(text) == text


def test_bad_paths_are_refused(run):
    robot = aj.load_robot("two_link")
    for plane in ("ab", "x", "xyz"):
        with pytest.raises(
            aj.errors.ApproxJacError, match=r"plane must name two world axes|not in plane"
        ):
            view.plot_path(run, robot, plane=plane)
    with pytest.raises(aj.InvalidInputError, match=r"target must have shape \(3,\)"):
        view.plot_path(run, robot, target=(1.0, 2.0))


def test_what_is_believed_and_the_target_are_drawn_if_asked_for(run):
    arm = aj.load_robot("two_link")
    held = arm.with_object(0.5, axis="x")
    target = (0.5, 0.3, 1.2)
    ax = view.plot_path(run, held, plane="zx", believed=arm, target=target)
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert_allclose(np.array(lines["believed path"].get_data()).T, run.x[:, ::-1], atol=1e-12)
    assert np.array(lines["target"].get_data()).T.tolist() == [[1.2, 0.5]]
    assert ax.get_title() == "Path of object_tip, z-x plane"
    for name, role in (("end", "true"), ("believed path", "believed"), ("target", "target")):
        assert lines[name].get_color() == view.COLORS[role]
    assert "believed path" not in [
        line.get_label() for line in view.plot_path(run, arm).get_lines()
    ]


def test_the_arm_is_drawn_with_its_fixed_parts():
    arm = aj.load_robot("panda")
    held = arm.with_object(0.2, axis="x")
    task = aj.PositionTask(held)
    controller = aj.SetpointController(task, aj.Gains(100.0, 20.0, 1.0))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    run = aj.simulate(aj.Plant(held, task), controller, task.value(q0), q0, 0.01, dt=0.01)
    lines = {line.get_label(): line for line in view.plot_path(run, held).get_lines()}
    drawn = np.array(lines["start"].get_data()).T
    hand = aj.PositionTask(held, frame="panda_hand_tcp").value(q0)[[0, 2]]
    assert_allclose(drawn[-2], hand, atol=1e-12)
    assert_allclose(drawn[-1], task.value(q0)[[0, 2]], atol=1e-12)


def test_learnt_parameters_are_drawn_beside_the_true_ones(run):
    scene = dataclasses.replace(run.scene, parameters={"a": "kg", "b": "kg m"})
    learnt = dataclasses.replace(
        run, learnt=np.outer(run.t, [1.0, 2.0]), scene=scene,
        derived=lambda run, name, at: lambda state: np.full(2, np.nan),
    )  # fmt: skip
    ax = view.plot_parameters(learnt, truth={"a": 0.9, "b": 1.9})
    lines = {line.get_label(): line for line in ax.get_lines()}
    assert_allclose(lines["b"].get_ydata(), 2.0 * run.t)
    assert ax.get_ylabel() == "learnt [kg or kg m]"
    assert view.plot_parameters(learnt, ["b"]).get_ylabel() == "learnt [kg m]"
    dashed = [line for line in ax.get_lines() if line.get_linestyle() == "--"]
    assert [line.get_ydata()[0] for line in dashed if len(line.get_ydata())] == [0.9, 1.9]


def test_parameters_that_were_not_learnt_are_refused(run):
    with pytest.raises(aj.InvalidInputError, match="run must be one in which something was learnt"):
        view.plot_parameters(run)


@pytest.mark.parametrize("plot", [view.plot_run, view.plot_error, view.plot_torque])
def test_what_is_no_run_is_refused(plot):
    with pytest.raises(aj.InvalidInputError, match="run must be a Trajectory, such as simulate"):
        plot(aj.load_robot("two_link"))


def test_what_is_learnt_of_kinematics_is_drawn_with_its_uncertainty(panda):
    task = aj.PositionTask(panda)
    controller = aj.TrackingController(task)
    truth = panda.with_object(0.1)
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    plant = aj.Plant(truth)
    run = aj.simulate(plant, controller, plant.sensor.value(q0) + 0.05, q0, 0.5, dt=1e-3)
    ax = view.plot_parameters(run, ["tool.z"], truth={"tool.z": 0.2})
    (learnt, true, _), (band,) = ax.lines, ax.collections
    assert learnt.get_label() == "tool.z"
    assert ax.get_ylabel() == "learnt, ± 2 sd [m]"
    assert list(true.get_ydata()) == [0.2, 0.2]
    last = controller.kinematics_learnt(run.state[-1]).rows[
        controller.kinematics.names.index("tool.z")
    ]
    assert learnt.get_ydata()[-1] == last.value
    edges = band.get_paths()[0].vertices
    assert np.isclose(edges[edges[:, 0] == run.t[-1], 1].max(), last.value + 2.0 * last.sd)
    low, high = ax.get_ylim()  # of what was learnt, not of the belief
    assert low < last.value - 2.0 * last.sd < last.value + 2.0 * last.sd < high
    assert high - low < 0.5 * np.ptp(edges[:, 1])
    with pytest.raises(aj.errors.UnknownNameError, match=r"tool.w.*what is learnt"):
        view.plot_parameters(run, ["tool.w"])
