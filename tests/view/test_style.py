"""The same look everywhere: words, units, legends, files and notebooks, over all plots."""

import dataclasses
import re

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

import approxjac as aj
from approxjac import view

UNIT = re.compile(r"\S.* \[\S.*\]")
HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
N = 40
rng = np.random.default_rng(0)


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("panda").with_object(0.2)


@pytest.fixture(scope="module")
def run(arm):
    task = aj.PositionTask(arm)
    controller = aj.SetpointController(task, aj.Gains(400.0, 80.0, 1.0))
    target = task.value(HOME) + 0.1
    return aj.simulate(aj.Plant(arm, task), controller, target, HOME, 0.4, dt=2e-3)


@pytest.fixture(scope="module")
def seen(arm):
    camera = aj.PinholeCamera.looking_at((0.5, 0.0, 0.4), (1.5, -0.8, 0.9), 600.0, (640, 480))
    return aj.ImageTask(arm, camera, points=[(0.0, 0.0, 0.0), (0.0, 0.1, 0.0)])


@pytest.fixture(scope="module")
def image_run(arm, seen):
    controller = aj.SetpointController(seen, aj.default_gains(seen))
    plant = aj.Plant(arm, seen, sensing=aj.Sensing(x_noise=2.0))
    return aj.simulate(plant, controller, seen.value(HOME + 0.1), HOME, 0.2, dt=2e-3)


@pytest.fixture(scope="module")
def calibration():
    belief = aj.load_robot("ur5")
    task, q = aj.PositionTask(belief), np.random.default_rng(1).uniform(-1.0, 1.0, (30, 6))
    return aj.calibrate(belief, aj.Recording(q, x=np.array([task.value(each) for each in q])))


@pytest.fixture(scope="module")
def plots(run, image_run, arm, seen, calibration):
    """All plots that take axes, as functions of them."""
    scene = dataclasses.replace(run.scene, parameters={"a": "kg", "b": "kg m"})
    learnt = dataclasses.replace(
        run, learnt=np.outer(run.t, [1.0, 2.0]), scene=scene,
        derived=lambda run, name, at: lambda state: np.full(2, np.nan),
    )  # fmt: skip
    belief = aj.load_robot("panda")
    tracking = aj.TrackingController(aj.PositionTask(belief))
    plant = aj.Plant(arm)
    followed = aj.simulate(plant, tracking, plant.sensor.value(HOME), HOME, 0.05, dt=1e-3)
    x, y = np.linspace(0.1, 1.0, 5), np.linspace(1.0, 2.0, 4)
    decay = x[None, :] - 0.2 * y[:, None]
    return {
        "plot_error": lambda ax: view.plot_error(run, ax),
        "plot_command": lambda ax: view.plot_command(run, ax),
        "plot_torque": lambda ax: view.plot_torque(run, ax),
        "plot_torque, limits": lambda ax: view.plot_torque(run, ax, limits=arm.effort_limits),
        "plot_slack": lambda ax: view.plot_slack(run, ax),
        "plot_path": lambda ax: view.plot_path(
            run, arm, ax=ax, believed=belief, target=run.target
        ),
        "plot_parameters": lambda ax: view.plot_parameters(
            learnt, ax=ax, truth={"a": 1.0, "b": 2.0}
        ),
        "plot_image": lambda ax: view.plot_image(image_run, seen.camera, ax),
        "plot_shares": lambda ax: view.plot_shares(
            x, y, np.clip(decay, 0.0, 1.0), own=(0.5, 1.5), ax=ax,
            labels=("true object_length [m]", "damping [N m s/rad]"),
        ),
        "plot_parameters, bands": lambda ax: view.plot_parameters(followed, ax=ax),
        "plot_residuals": lambda ax: view.plot_residuals(calibration, ax),
        "plot_determined": lambda ax: view.plot_determined(calibration, ax),
        "plot_accuracy": lambda ax: view.plot_accuracy(calibration, "xy", ax),
    }  # fmt: skip


NAMES = (
    "plot_error", "plot_command", "plot_torque", "plot_torque, limits", "plot_slack", "plot_path",
    "plot_parameters", "plot_image",
    "plot_shares", "plot_parameters, bands", "plot_residuals", "plot_determined", "plot_accuracy",
)  # fmt: skip


def test_symbols_on_the_axes_of_maps_are_formulas():
    grid = np.array([[1.0, 2.0], [3.0, 4.0]])
    labels = ("gain ratio k_p / k_v", "added damping B_c")
    ax = view.plot_shares(*grid, grid, labels=labels)
    assert ax.get_xlabel() == "gain ratio $k_{p}$ / $k_{v}$"
    assert ax.get_ylabel() == "added damping $B_{c}$"


def test_no_plot_is_forgotten(plots):
    public = {name for name in vars(view) if name.startswith("plot_")}
    assert {name.split(",")[0] for name in NAMES} | {"plot_run"} == public
    assert set(plots) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_plot_says_what_is_seen_in_which_unit_and_covers_none_of_it(plots, name):
    ax = plots[name](None)
    ax.figure.draw_without_rendering()  # the layout is made when drawing
    assert len(ax.get_title()) > 10
    assert UNIT.fullmatch(ax.get_xlabel())
    assert UNIT.fullmatch(ax.get_ylabel())
    for bar in ax.figure.axes:
        assert bar is ax or "[" in bar.get_ylabel()  # of colours
    everything, plot = ax.figure.get_tightbbox(), ax.get_window_extent()
    size = ax.figure.get_size_inches()
    assert everything.x0 > -0.01
    assert everything.y0 > -0.01
    assert everything.x1 < size[0] + 0.01
    assert everything.y1 < size[1] + 0.01
    legend = ax.get_legend().get_window_extent()
    labels = ax.xaxis.get_tightbbox()
    assert legend.y1 < labels.y0 < plot.y0


@pytest.mark.parametrize("name", NAMES)
def test_axes_of_the_user_go_in_and_come_out_and_settings_are_left_alone(plots, name):
    before, figure = dict(matplotlib.rcParams), Figure()
    ax = figure.subplots()
    assert plots[name](ax) is ax
    assert type(figure) is Figure
    assert dict(matplotlib.rcParams) == before


def test_the_look_does_not_depend_on_the_users_settings_or_on_who_saves(run, tmp_path):
    view.save_figure(view.plot_error(run).figure, tmp_path / "ours")
    with matplotlib.rc_context({"font.size": 20.0, "axes.grid": False, "grid.alpha": 1.0}):
        view.plot_error(run).figure.savefig(tmp_path / "other.png", dpi=130)
    shell = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell
    display = shell.instance().display_formatter
    shown, _ = display.format(view.plot_error(run).figure)
    assert set(shown) == {"image/png", "text/plain"}
    (tmp_path / "shown.png").write_bytes(shown["image/png"])
    for name in ("other", "shown"):
        assert np.array_equal(imread(tmp_path / f"{name}.png"), imread(tmp_path / "ours.png"))
    own = Figure()
    view.plot_error(run, own.subplots())
    assert set(display.format(own)[0]) == {"text/plain"}  # those of users are left alone


@pytest.mark.study
def test_pictures_of_long_rough_runs_are_small(run, image_run, seen, tmp_path):
    t = np.linspace(0.0, 10.0, 10_001)
    rough = rng.normal(size=(len(t), 7))
    long = dataclasses.replace(run, t=t, tau=rough)
    paths = view.save_figure(view.plot_torque(long).figure, tmp_path / "run")
    images = np.cumsum(rough[:, :4], axis=0) + 200.0
    noisy = images + rng.normal(size=images.shape)
    long = dataclasses.replace(image_run, t=t, x=images, x_measured=noisy, error=rough[:, :4])
    paths += view.save_figure(view.plot_image(long, seen.camera).figure, tmp_path / "image")
    for path in paths:
        assert path.stat().st_size < 500_000, path.name
    assert "<text" not in paths[1].read_text(encoding="utf-8")  # letters are paths: any machine
