"""Pages of runs in a real browser: what they show is where it is, and nothing is complained of."""

import dataclasses
import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pictures import near, pixels
from scenarios import camera

import approxjac as aj
from approxjac import view
from approxjac.controllers import RegressorGravity
from approxjac.paper import experiments as paper
from approxjac.robots import GravityRegressor
from approxjac.scenario import run_scenario
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import FrameKinematics
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.page import document, page_data
from approxjac.view.browser.stage import Stage
from approxjac.view.style import COLORS, SERIES

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
BLUE = SERIES[0]


@pytest.fixture(scope="module")
def reach(panda):
    """A Panda whose controller believes its 20 cm tool absent."""
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    regressor = GravityRegressor(belief)
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        aj.Gains(kp=400.0, kv=80.0, damping=1.0),
        gravity=RegressorGravity(regressor, regressor.fit(truth)[0]),
    )
    target = plant.sensor.value(START) + [0.1, -0.15, 0.16]
    return aj.simulate(plant, controller, target, START, 2.5, dt=1e-3)


@pytest.fixture(scope="module")
def drawn():
    """The paper's arm with all wrong, camera and lengths."""
    plant, controller = paper.build(paper.EXPERIMENTS[7])
    target = plant.sensor.value(np.array(paper.TARGET))
    return aj.simulate(plant, controller, target, paper.START, 60.0, dt=None)


@pytest.fixture(scope="module")
def watched():
    """A camera in the room that is rolled against what is believed of it."""
    rolled = {"camera": {"roll": 0.5}}
    scenario = camera(believed=rolled, loop={"dt": 0.002}, run={"duration": 3.0, "seed": 2})
    return run_scenario(scenario).run


@pytest.fixture(scope="module")
def page_of(tmp_path_factory):
    """The file of a run's page, written once: simplifying meshes takes a second."""
    folder, written = tmp_path_factory.mktemp("pages"), {}

    def page_of_(run):
        if run not in written:
            written[run] = view.save_page(run, folder / f"{len(written)}.html")
        return written[run]

    return page_of_


@pytest.fixture(scope="module")
def last(open_pages):
    """Opens a page, or takes that of the last call if it is the same: opening takes a second."""
    kept = {}

    def last_(*where):
        if where not in kept:
            for page in kept.values():
                page.close()
            kept.clear()
            kept[where] = open_pages(*where)
        return kept[where]

    return last_


@pytest.fixture
def show(last, page_of):
    """Opens a run's page at its start, as it was opened first."""

    def show_(run, size=(1000, 700)):
        page = last(page_of(run), size)
        page.mouse.move(1, 1)
        page.evaluate("approxjac.pause(); approxjac.seek(0); document.activeElement.blur()")
        page.locator("#speed").select_option("1")
        page.get_by_role("button", name="Reset view").click()
        return page

    return show_


def seek(page, t):
    page.evaluate("t => approxjac.seek(t)", float(t))
    drawn_anew(page)


def drawn_anew(page):
    """Wait until what was asked for has been drawn."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => setTimeout(done, 60)))")


def project(page, point):
    at = page.evaluate("point => approxjac.project(point)", np.asarray(point).tolist())
    return np.array([at["x"], at["y"]])


def position(robot, q):
    return FrameKinematics(robot, robot.tip).position(q)


def state(page):
    return page.evaluate("approxjac.state()")


# -- the arm reaches its target, the ghost does not ------------------------------------------


@pytest.mark.long
def test_the_paper_arm_reaches_the_line_of_sight(drawn, show):
    page = show(drawn)
    seek(page, drawn.t[-1])
    scene = drawn.scene
    q_end = drawn.q[-1]
    tip = position(scene.truth, q_end)
    ghost = position(scene.belief, q_end)
    goal = position(scene.truth, np.array(paper.TARGET))
    assert np.linalg.norm(project(page, tip) - project(page, goal)) < 6.0
    assert np.linalg.norm(project(page, ghost) - project(page, goal)) > 40.0
    image = pixels(page)
    assert near(image, project(page, tip), COLORS["true"]) > 40
    assert near(image, project(page, ghost), COLORS["believed"]) > 40
    # the line of sight of the target pixel goes through the goal, seen on its way there too
    eye = page.evaluate("approxjac.data.cameras[0].apex")
    assert near(image, project(page, 0.5 * (np.array(eye) + goal)), COLORS["target"], 4.0, 0.4) > 3


def test_the_path_goes_to_the_tip(reach, show):
    """Between two instants, too; and all of it is in view."""
    page = show(reach)
    box = page.locator("#canvas").bounding_box()
    for t in (0.4103, 1.25, reach.t[-1]):
        seek(page, t)
        end, tip = page.evaluate("""() => {
            const { viewer } = approxjac, THREE = MeshCat.THREE, s = approxjac.state();
            const mesh = viewer.scene_tree.find(["trail tip", "<object>"]).object;
            const matrix = new THREE.Matrix4();
            mesh.getMatrixAt(mesh.count - 1, matrix);
            const tip = viewer.scene_tree.find(["tip"]).object.position;
            return [new THREE.Vector3(0, 0.5, 0).applyMatrix4(matrix).toArray(), tip.toArray()];
        }""")
        assert_allclose(end, tip, atol=1e-5)
    tips = page.evaluate("approxjac.column('tip').map((p) => approxjac.project(p))")
    for place in tips:
        assert box["x"] < place["x"] < box["x"] + box["width"]
        assert box["y"] < place["y"] < box["y"] + box["height"]


def test_what_a_camera_in_the_room_sees(watched, show):
    page = show(watched)
    seek(page, watched.t[-1])
    tip = position(watched.scene.truth, watched.q[-1])
    assert near(pixels(page), project(page, tip), COLORS["true"]) > 30
    panel = page.get_by_label("Image plane")
    box = panel.bounding_box()
    part = pixels(page)[int(box["y"]) :, int(box["x"]) :]
    middle = np.array([box["width"], box["height"]]) / 2.0
    for colour in (COLORS["true"], COLORS["believed"], COLORS["target"]):
        assert near(part[: int(box["height"])], middle, colour, 400.0) > 20, colour


def test_the_tip_reaches_the_target_and_the_ghosts_does_not(reach, show):
    page = show(reach)
    seek(page, reach.t[-1])
    scene = reach.scene
    tip = project(page, scene.sensor.value(reach.q[-1]))
    ghost = project(page, scene.task.value(reach.q[-1]))
    target = project(page, reach.target)
    assert np.linalg.norm(tip - target) < 4.0
    assert np.linalg.norm(ghost - target) > 40.0
    image = pixels(page)
    assert near(image, tip, COLORS["true"]) > 60
    assert (
        near(image, target, COLORS["target"], radius=20.0, tolerance=0.4) > 60
    )  # it lets light through
    assert near(image, ghost, COLORS["believed"]) > 60
    assert near(image, ghost, COLORS["true"]) == near(image, tip, COLORS["believed"]) == 0


# -- time ------------------------------------------------------------------------------------


def test_the_slider_moves_the_arm(reach, show):
    page = show(reach)
    drawn_anew(page)
    first = pixels(page)
    slider = page.get_by_role("slider", name="Time")
    slider.focus()
    page.keyboard.press("End")
    drawn_anew(page)
    assert state(page)["t"] == pytest.approx(reach.t[-1])
    last = pixels(page)
    assert (np.abs(first - last).max(axis=2) > 20.0).sum() > 3000
    box = slider.bounding_box()
    page.mouse.click(box["x"] + 0.1 * box["width"], box["y"] + 0.5 * box["height"])
    drawn_anew(page)
    t = state(page)["t"]
    assert t == pytest.approx(0.1 * reach.t[-1], abs=0.05)
    q = [np.interp(t, reach.t, column) for column in reach.q.T]
    image = pixels(page)
    assert near(image, project(page, reach.scene.sensor.value(q)), COLORS["true"]) > 60
    assert page.locator("#time").inner_text() == f"{t:.2f} / {reach.t[-1]:.2f} s"


def test_playing_moves_cursor_and_time_and_ends(reach, show):
    page = show(reach)
    before = page.locator(".now").first.bounding_box()["x"]
    page.locator("#speed").select_option("4")
    page.locator("#play").click()
    page.wait_for_function("approxjac.state().t > 0.2")
    page.wait_for_function("!approxjac.state().playing")
    assert state(page)["t"] == pytest.approx(reach.t[-1])
    assert page.locator(".now").first.bounding_box()["x"] > before + 100.0
    assert page.locator("#play").get_attribute("aria-label") == "Play"
    page.locator("#stage").click(position={"x": 20, "y": 20})
    page.evaluate("document.activeElement.blur()")
    page.locator("#speed").select_option("0.25")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Space")  # from the start again
    page.wait_for_function("approxjac.state().t < 1.0")
    page.keyboard.press("Space")
    paused = state(page)
    assert not paused["playing"]
    page.keyboard.press("ArrowRight")
    assert state(page)["index"] == paused["index"] + 1


@pytest.mark.long
def test_a_page_plays_once_when_it_is_opened(reach, open_page, page_of):
    page = open_page(page_of(reach), motion="no-preference")
    page.wait_for_function("approxjac.state().t > 0.1")
    page.wait_for_function("!approxjac.state().playing")
    assert state(page)["t"] == pytest.approx(reach.t[-1])


def test_dragging_in_a_plot_seeks(reach, show):
    page = show(reach)
    box = page.locator(".u-over").nth(1).bounding_box()
    y = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.2 * box["width"], y)
    page.mouse.down()
    assert state(page)["t"] == pytest.approx(0.2 * reach.t[-1], abs=0.03)
    page.mouse.move(box["x"] + 0.7 * box["width"], y, steps=3)
    page.mouse.up()
    assert state(page)["t"] == pytest.approx(0.7 * reach.t[-1], abs=0.03)
    assert_allclose(page.locator(".now").nth(1).bounding_box()["x"],
                    box["x"] + 0.7 * box["width"], atol=3.0)  # fmt: skip


def test_plots_have_lines_titles_and_units(reach, show):
    page = show(reach)
    drawn_anew(page)
    titles = page.locator(".plot h2").all_inner_texts()
    assert titles == ["Task error of each coordinate", "Torque of each joint", "Lyapunov function"]
    image = pixels(page)
    for i, colours in enumerate((SERIES[:3], (SERIES[1], SERIES[5]), SERIES[:1])):
        box = page.locator(".plot .area").nth(i).bounding_box()
        part = image[int(box["y"]) : int(box["y"] + box["height"]), int(box["x"]) :]
        for colour in colours:
            assert near(part, (150, 60), colour, 400.0) > 15, (titles[i], colour)
    labels = page.evaluate("approxjac.data.plots.map((plot) => plot.unit)")
    assert labels == ["error [mm]", "τ / limit", "V [J]"]
    keys = page.locator(".plot .keys").first.inner_text()
    assert re.sub(r"\s+", " ", keys).startswith("x −100 y 150 z −160")


def test_the_view_can_be_turned_and_reset(reach, show):
    page = show(reach)
    before = project(page, reach.target)
    page.mouse.move(250, 500)
    page.mouse.down()
    page.mouse.move(330, 500, steps=4)
    page.mouse.up()
    drawn_anew(page)
    assert np.linalg.norm(project(page, reach.target) - before) > 20.0
    page.get_by_role("button", name="Reset view").click()
    assert_allclose(project(page, reach.target), before, atol=1e-3)


@pytest.mark.parametrize(
    "size",
    [(1000, 700), *(pytest.param(s, marks=pytest.mark.long) for s in ((1600, 900), (600, 800)))],
)
def test_all_of_the_motion_is_in_view(reach, show, size):
    page = show(reach, size)
    box = page.locator("#canvas").bounding_box()
    for q in reach.q[::250]:
        x, y = project(page, reach.scene.sensor.value(q))
        assert box["x"] < x < box["x"] + box["width"]
        assert box["y"] < y < box["y"] + box["height"]
    for name in ("#play", "#slider", "#speed", "#time"):
        control = page.locator(name).bounding_box()
        assert control["x"] + control["width"] <= size[0]
        assert control["y"] + control["height"] <= size[1]


# -- states ----------------------------------------------------------------------------------


def test_a_link_with_its_torque_at_the_limit_is_coloured(reach, show):
    limits = np.full(7, np.inf)
    limits[1] = 0.5 * np.abs(reach.tau[:, 1]).min()
    page = show(dataclasses.replace(
        reach, scene=dataclasses.replace(reach.scene, torque_limits=limits)
    ))  # fmt: skip
    drawn_anew(page)
    assert "torque at its limit: panda_joint2" in page.locator("#state").inner_text()
    box = page.locator("#canvas").bounding_box()
    assert near(pixels(page), (0.5 * box["width"], 350.0), COLORS["saturated"], 300.0) > 500


@pytest.mark.long
def test_a_link_at_a_position_limit_is_coloured(reach, show):
    q = reach.q.copy()
    q[:, 3] = reach.scene.truth.position_limits[0][3]
    page = show(dataclasses.replace(reach, q=q))
    drawn_anew(page)
    assert "at a position limit: panda_joint4" in page.locator("#state").inner_text()
    box = page.locator("#canvas").bounding_box()
    assert near(pixels(page), (0.5 * box["width"], 350.0), COLORS["at_limit"], 300.0) > 500


@pytest.mark.long
def test_lost_measurements_are_gaps(reach, show):
    x_measured, error = reach.x_measured.copy(), reach.error.copy()
    x_measured[500:900] = error[500:900] = np.nan
    page = show(dataclasses.replace(reach, x_measured=x_measured, error=error))
    assert "not measured16 % of the time" in page.locator("#facts").inner_text()
    seek(page, 1e9)
    lost = page.evaluate("approxjac.column('measured').map((p) => !p.every(Number.isFinite))")
    drawn = page.evaluate("""() => {
        const mesh = approxjac.viewer.scene_tree.find(["trail measured", "<object>"]).object;
        return Array.from({ length: mesh.count }, (_, i) =>
            [0, 1, 2].some((k) => mesh.instanceMatrix.array[16 * i + k] !== 0));
    }""")
    assert sum(lost) > 10
    assert drawn == [not (a or b) for a, b in pairwise(lost)]
    seek(page, 0.7)
    measured = page.evaluate("approxjac.viewer.scene_tree.find(['measured']).object.visible")
    assert not measured
    assert page.locator(".plot .keys").first.inner_text().startswith("x –")
    seek(page, 1.5)
    assert page.evaluate("approxjac.viewer.scene_tree.find(['measured']).object.visible")


@pytest.mark.long
def test_a_controller_that_tells_no_belief(reach, show):
    scene = dataclasses.replace(reach.scene, belief=None, task=None)
    nothing = np.full_like(reach.task_torque, np.nan)
    unknown = {"task_torque": nothing, "V": nothing[:, 0], "events": ()}
    run = dataclasses.replace(reach, scene=scene, derived=lambda run, name, at: unknown[name][at])
    page = show(run)
    seek(page, reach.t[-1])
    titles = page.locator(".plot h2").all_inner_texts()
    assert titles == ["Task error of each coordinate", "Torque of each joint"]
    box = page.locator("#canvas").bounding_box()
    assert near(pixels(page), (0.5 * box["width"], 350.0), COLORS["believed"], 300.0) == 0


def test_without_webgl_there_are_the_plots(drawn, browser, tmp_path):
    page = browser.new_page(viewport={"width": 1000, "height": 700})
    page.add_init_script("""
        const real = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
            return kind.includes("webgl") ? null : real.call(this, kind, ...rest);
        };
    """)
    page.goto(view.save_page(drawn, tmp_path / "run.html").as_uri())
    assert "This browser cannot draw the arm" in page.locator("#canvas").inner_text()
    page.evaluate("approxjac.pause(); approxjac.seek(1.0)")
    assert state(page)["t"] == 1.0
    assert page.locator(".plot").count() == 4
    page.close()


# -- pages of runs that go on ------------------------------------------------------------------


def live_page(scene, row, *scripts):
    """A page of one instant that waits for more."""
    columns = RunFrames(scene).columns(row)
    return document(page_data(Stage(scene), row, columns, row.q, "live", live=True), *scripts)


def rows_of(run, every=100):
    names = ("t", "q", "x_measured", "x_d", "error", "tau", "task_torque", "V", "learnt")
    return [
        SimpleNamespace(
            task_labels=run.task_labels,
            task_units=run.task_units,
            command_kind=run.command_kind,
            has_torque=run.has_torque,
            units=run.units,
            at=lambda name, _, i=i: getattr(run, name)[i : i + 1],
            **{name: getattr(run, name)[i : i + 1] for name in names},
        )
        for i in range(0, len(run.t), every)
    ]


def test_instants_come_in_and_the_target_is_dragged(reach, open_page, tmp_path):
    scene, rows = reach.scene, rows_of(reach)
    path = tmp_path / "live.html"
    path.write_text(live_page(scene, rows[0]), encoding="utf-8")
    page = open_page(path)
    assert state(page) == {"t": 0, "index": 0, "playing": False, "length": 1}
    frames = RunFrames(scene)
    for row in rows[1:]:
        instant = {name: column[0].tolist() for name, column in frames.columns(row).items()}
        page.evaluate("row => approxjac.append(row)", instant)
    page.wait_for_timeout(200)
    assert state(page)["length"] == len(rows)
    assert state(page)["t"] == pytest.approx(reach.t[-1])  # it follows
    assert near(pixels(page), project(page, scene.sensor.value(reach.q[-1])), COLORS["true"]) > 60
    # drag the target 30 px to the right: the view does not turn
    page.evaluate("approxjac.ontarget = (point) => { window.dragged = point; }")
    x, y = project(page, reach.target)
    page.mouse.move(x + 12, y)
    page.mouse.down()
    page.mouse.move(x + 42, y, steps=5)
    page.mouse.up()
    dragged = page.evaluate("window.dragged")
    assert_allclose(project(page, reach.target), (x, y), atol=1e-6)
    assert_allclose(project(page, dragged), (x + 42, y), atol=1.5)
    # a cursor that was moved back stays where it is
    seek(page, 1.0)
    page.evaluate("row => approxjac.append(row)", instant | {"t": 9.0})
    assert state(page)["t"] == pytest.approx(1.0)
    # the believed robot changes
    longer = scene.truth.with_kinematic_error({"panda_joint4": (0.0, -0.1, 0.0)})
    other = Scene(scene.truth, longer, scene.sensor, scene.task.on(longer), scene.torque_limits)
    page.evaluate("changed => approxjac.redraw(changed)", Stage(other).data("believed"))
    drawn_anew(page)
    box = page.locator("#canvas").bounding_box()
    ghost = near(pixels(page), (0.5 * box["width"], 350.0), COLORS["believed"], 300.0)
    assert ghost > 500


def test_a_target_in_the_image_is_dragged(watched, open_page, tmp_path):
    listening = "approxjac.onpixel = (...x) => { window.moved = x; };"
    path = tmp_path / "live.html"
    path.write_text(live_page(watched.scene, rows_of(watched)[0], listening), encoding="utf-8")
    page = open_page(path)
    drawn_anew(page)
    target = watched.target[:2]
    # where it is on the page, from what dragging there tells
    box = page.get_by_label("Paths of the points through the image").bounding_box()
    at = page.evaluate("([u, v]) => approxjac.image.toPage(u, v)", target.tolist())
    x, y = box["x"] + at[0], box["y"] + at[1]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 10, y + 5)
    page.mouse.up()
    i, (u, v) = page.evaluate("window.moved")
    assert i == 0
    assert u > target[0] + 5.0
    assert (u - target[0]) / (v - target[1]) == pytest.approx(2.0, rel=0.05)


# -- what is there to see, and how ---------------------------------------------------------------


def legend(page):
    return page.locator("#legend li:visible").all_inner_texts()


@pytest.mark.long
def test_the_legend_names_what_occurs(reach, show):
    free = dataclasses.replace(reach.scene, torque_limits=np.full(7, 500.0))
    named = legend(show(dataclasses.replace(reach, scene=free)))
    assert named[:4] == [
        "true arm", "held object", "believed arm",
        "believed tip",
    ]  # fmt: skip
    for words in ("measured tip", "torque limit", "at a position limit", "in plots"):
        assert not any(words in text for text in named)
    limits = np.full(7, np.inf)
    limits[1] = 0.5 * np.abs(reach.tau[:, 1]).min()
    limited = dataclasses.replace(reach.scene, torque_limits=limits)
    x_measured = reach.x_measured + 0.02
    other = show(dataclasses.replace(reach, scene=limited, x_measured=x_measured))
    assert "link near or at its torque limit" in legend(other)
    assert "measured tip, where it differs" in legend(other)


@pytest.mark.long
def test_a_belief_that_is_right_is_not_drawn(reach, show):
    scene = reach.scene
    right = dataclasses.replace(scene, belief=scene.truth, task=scene.sensor)
    page = show(dataclasses.replace(reach, scene=right))
    drawn_anew(page)
    assert not any("believe" in text for text in legend(page))
    assert "believed" not in page.locator("#state").inner_text()
    box = page.locator("#canvas").bounding_box()
    assert near(pixels(page), (0.5 * box["width"], 350.0), COLORS["believed"], 300.0) == 0


@pytest.mark.long
def test_the_rim_of_the_ghost_lies_around_the_arm_only(reach, open_page, page_of):
    """Nothing of it, such as at bolts and edges, is seen on the arm."""
    page = open_page(page_of(reach), (1400, 900))
    page.evaluate("approxjac.pause(); approxjac.seek(0)")
    page.evaluate("""() => {  // markers and arrow aside
        for (const name of ["target", "believed_tip", "measured", "tip", "force"]) {
            approxjac.viewer.scene_tree.find([name]).object.traverse((o) => o.layers.set(5));
        }
        approxjac.viewer.set_dirty();
    }""")
    drawn_anew(page)
    image = pixels(page)[:, :850]
    pink = (image[..., 0] - image[..., 1] > 40.0) & (image[..., 2] - image[..., 1] > 15.0)
    pink[:110] = False  # of the legend
    assert pink.sum() > 1000
    background = image.min(axis=2) > 215.0  # and the grid
    reached = background.copy()
    for _ in range(7):  # how far the rim reaches from the background
        grown = reached.copy()
        grown[1:] |= reached[:-1]
        grown[:-1] |= reached[1:]
        grown[:, 1:] |= reached[:, :-1]
        grown[:, :-1] |= reached[:, 1:]
        reached = grown
    assert (pink & ~reached).sum() < 0.03 * pink.sum()  # in gaps as of fingers


@pytest.mark.long
@pytest.mark.parametrize("size", [(1400, 900), (400, 800)])
def test_a_dark_page(watched, open_page, page_of, size):
    page = open_page(page_of(watched), size)
    page.emulate_media(color_scheme="dark", reduced_motion="reduce")
    drawn_anew(page)
    page.wait_for_timeout(200)
    image = pixels(page)
    assert (image.max(axis=2) > 200.0).mean() < 0.08  # of texts and what is drawn
    assert np.median(image) < 60.0
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    page.emulate_media(color_scheme="light")
    drawn_anew(page)
    page.wait_for_timeout(200)
    assert np.median(pixels(page)) > 230.0
