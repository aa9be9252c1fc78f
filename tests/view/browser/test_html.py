"""The page as a file: what is in it, how large it is, and what is refused."""

import base64
import dataclasses
import hashlib
import json
import re
import sys
import webbrowser

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import view
from approxjac.controllers import Wall
from approxjac.simulation import Condition, Event
from approxjac.view.browser.frames import _peaks
from approxjac.view.browser.page import _thinned, page, policy_of

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


@pytest.fixture(scope="module")
def run():
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(60.0, 20.0))
    return aj.simulate(aj.Plant(arm, task), controller, (0.5, 1.2), (0.3, 0.8), 1.0, dt=None)


def data_of(text):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found.group(1))


def column(data, name):
    numbers = np.frombuffer(base64.b64decode(data["columns"][name]), "<f4")
    return numbers.reshape(-1, *data["shapes"][name])


def test_a_run_writes_its_page(run, tmp_path):
    path = view.save_page(run, tmp_path / "run.html", "Two links & <more>")
    text = path.read_text(encoding="utf-8")
    assert text == page(run, title="Two links & <more>")
    assert "<title>Two links &amp; &lt;more&gt;</title>" in text
    assert '<meta name="generator" content="approxjac">' in text[:4000]
    assert data_of(text)["title"] == "Two links & <more>"
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_the_page_hands_on_the_licences_of_what_is_inside(run):
    text = page(run)
    for name in ("Leon Sorokin", "Robin Deits", "three.js authors"):
        assert name in text, name


def test_a_title_may_be_anything_and_cannot_end_the_script(run):
    title = "{{scripts}} \\1 </script><script>alert(1)</script>"
    text = page(run, title)
    assert data_of(text)["title"] == title
    assert text.count("alert(1)") == 3  # title, heading, data
    assert "<script>alert" not in text


def test_its_policy_allows_its_own_scripts_and_nothing_of_the_network(run):
    text = page(run, '{{policy}} Policy" content="')
    policy = dict(part.split(" ", 1) for part in policy_of(text).split("; "))
    scripts = re.findall("<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(each.encode()).digest()) for each in scripts]
    assert policy["script-src"].split() == [f"'sha256-{each.decode()}'" for each in hashes]
    assert policy["default-src"] == policy["form-action"] == "'none'"
    assert "connect-src" not in policy
    assert "http" not in policy_of(text)
    assert text.index("Content-Security-Policy") < text.index("<style>")


@pytest.mark.browser
def test_a_script_that_was_put_into_a_page_does_not_run(run, tmp_path, browser):
    text, put = page(run), "<script>document.title = 'put in'</script>"
    path = tmp_path / "changed.html"
    path.write_text(text.replace("<h1>", f'{put}<img src="http://127.0.0.1:9/x"><h1>', 1), "utf-8")
    opened, said = browser.new_page(), []
    opened.on("console", lambda message: said.append(message.text))
    opened.goto(path.as_uri())
    assert opened.title() != "put in"
    opened.close()
    for directive in ("script-src", "img-src"):
        assert any(directive in each for each in said)


def pushed(run):
    event = Event(Condition.PUSHED, 0.3, 0.36, 0.5, "towards (1.00, 0.00, 0.00)", "20 N")
    known = run.derived

    def derived(run, name, at):
        return (event,) if name == "events" else known(run, name, at)

    return dataclasses.replace(run, derived=derived)


def test_what_happened_is_told_with_its_time(run):
    data = data_of(page(pushed(run)))
    assert data["events"] == [{"from": 0.3, "to": 0.5, "name": "pushed"}]
    told = dict(data["facts"])["pushed"]
    assert "from 0.30 s to 0.50 s" in told
    assert "20 N" in told
    assert data_of(page(run))["events"] == []


@pytest.mark.browser
def test_what_happened_is_shaded_in_the_plots_and_told_while_it_lasts(run, tmp_path, open_page):
    shown = open_page(view.save_page(pushed(run), tmp_path / "pushed.html"))
    says = "document.querySelector('#state').innerText.includes('pushed')"
    for t, expected in ((0.2, "false"), (0.4, "true"), (0.6, "false")):
        shown.evaluate("t => { approxjac.pause(); approxjac.seek(t); }", t)
        shown.wait_for_function(f"{says} === {expected}", timeout=5_000)
    painted = shown.evaluate("""() => {
        const canvas = document.querySelector(".plot canvas"), { width, height } = canvas;
        const row = canvas.getContext("2d").getImageData(0, height >> 1, width, 1).data;
        return Array.from({ length: width }, (_, i) => row[4 * i + 3]);
    }""")
    runs = np.flatnonzero(np.diff(np.array(painted) > 20))
    assert np.max(np.diff(runs)) > 0.1 * len(painted)  # a band, not only lines


@pytest.fixture(scope="module")
def walled():
    """A run in front of a wall, by a limiter within another wrapper."""
    arm = aj.load_robot("two_link")
    law = aj.SetpointController(aj.PositionTask(arm, axes="xz"), aj.Gains(60.0, 20.0))
    wall = Wall([0.4, 0.0, 0.3], [3.0, 0.0, 4.0])
    limited = aj.HeldMeasurement(aj.TorqueLimited(law, wall, dt=2e-3), unseen=0.1)
    return aj.simulate(aj.Plant(arm, law.task), limited, (0.5, 1.2), (0.3, 0.8), 0.1, dt=2e-3)


def test_a_wall_is_drawn_where_the_tip_would_meet_it(walled, run, tmp_path):
    data = data_of(page(walled))
    ((centre, normal),) = np.array(data["walls"])
    assert_allclose(normal, [0.6, 0.0, 0.8])
    assert_allclose(normal @ (centre - [0.4, 0.0, 0.3]), 0.0, atol=1e-9)
    beside = np.concatenate([column(data, name) for name in ("tip", "target")]) - centre
    assert np.linalg.norm(np.cross(beside, normal), axis=1).min() < 0.5
    assert "wall" in [what for what, *_ in data["legend"]]
    assert data_of(page(aj.Trajectory.load(walled.save(tmp_path / "walled")))) == data
    without = data_of(page(run))
    assert without["walls"] == []
    assert "wall" not in [what for what, *_ in without["legend"]]


@pytest.mark.browser
def test_a_wall_is_in_the_scene_and_its_legend(walled, tmp_path, open_page):
    shown = open_page(view.save_page(walled, tmp_path / "walled.html"))
    ((centre, normal),) = data_of(page(walled))["walls"]
    found = shown.evaluate("""() => {
        const pane = approxjac.viewer.scene_tree.find(["wall0", "pane", "<object>"]).object;
        const y = new MeshCat.THREE.Vector3(0, 1, 0).applyQuaternion(pane.quaternion);
        return [pane.position.toArray(), y.toArray()];
    }""")
    assert_allclose(found, [centre, normal], atol=1e-6)
    assert "wall that a limit" in shown.inner_text("#legend")


def test_columns_are_those_of_the_run(run):
    data = data_of(page(run))
    t = column(data, "t")
    assert len(t) == 61  # 60 a second
    kept = _thinned(run.t, run.q)
    assert_allclose(t, run.t[kept], atol=1e-6)
    assert_allclose(column(data, "joints"), run.q[kept], atol=1e-6)
    assert_allclose(column(data, "error"), 1e3 * run.error[kept], rtol=1e-5, atol=1e-6)
    assert_allclose(column(data, "tip")[:, [0, 2]], run.x[kept], atol=1e-6)


def test_first_and_last_instant_are_kept():
    for t in (np.linspace(0.0, 100.0, 50001), np.linspace(2.0, 2.5, 500), np.array([0.0, 9.0])):
        kept = _thinned(t, np.zeros((len(t), 2)))
        assert kept[0] == 0
        assert kept[-1] == len(t) - 1
        assert (np.diff(kept) > 0).all()
        assert len(kept) <= 1000
        assert len(kept) <= 60.0 * (t[-1] - t[0]) + 2
    assert_array_equal(_thinned(np.array([0.0]), np.zeros((1, 2))), [0])


def test_more_instants_are_kept_where_the_arm_is_fast():
    t = np.linspace(0.0, 100.0, 20_001)
    q = np.column_stack([1.0 - np.exp(-t), 0.0 * t])
    kept = _thinned(t, q)
    assert np.abs(np.diff(q[kept, 0])).max() < 0.01  # 0.1 if they were shared out by time alone
    assert np.diff(t[kept]).max() < 0.25


def test_no_peak_is_lost_between_instants(rng):
    tau = rng.normal(size=(100, 3))
    tau[37, 1] = -50.0
    kept = np.array([0, 10, 30, 40, 99])
    peaks = _peaks(tau, kept)
    assert_array_equal(peaks[0], tau[0])
    assert peaks[3, 1] == -50.0
    assert_allclose(np.abs(peaks[1:]).max(axis=0), np.abs(tau[1:]).max(axis=0))


def test_what_the_page_says_of_the_run(run):
    lost = run.x_measured.copy()
    lost[:100] = np.nan
    facts = dict(data_of(page(dataclasses.replace(run, x_measured=lost)))["facts"])
    norm = 1e3 * run.error_norm
    assert facts["error"] == f"{norm[0]:.4g} → {norm[-1]:.4g} mm"
    assert facts["not measured"] == "9.99 % of the time"


def test_the_page_of_a_pose_has_an_error_of_each_unit_and_of_each_object(panda):
    """And says of what it holds how long that is and how long it is believed to be."""
    bare = aj.Robot(panda.urdf.replace("/visual/", "/gone/"), tip=panda.tip)  # quickly drawn
    truth, belief = bare.with_object(0.2), bare.with_object(0.05)
    plant = aj.Plant(truth, aj.PoseTask(truth))
    away = np.array([0.03, 0.0, 0.04, 0.1, 0.0, 0.0])
    x_d = plant.sensor.displaced(plant.sensor.value(START), away)
    law = aj.SetpointController(aj.PoseTask(belief))
    pose = aj.simulate(plant, law, x_d, START, 0.002, dt=1e-3)
    facts = data_of(page(pose))["facts"]
    errors = [said.partition(" → ") for name, said in facts if name == "error"]
    assert [(first, last.split()[1]) for first, _, last in errors] == [
        ("50", "mm"),
        ("5.73", "deg"),
    ]
    assert ["object", "0.2 m long, believed 0.05 m"] in facts


@pytest.mark.study
def test_the_page_says_what_held_for_most_of_the_time(run):
    """Also statuses of two kinds whose numbers are the same."""
    for status in (*aj.Status, *aj.LimitStatus):
        name = "limit_status" if isinstance(status, aj.LimitStatus) else "status"
        most = np.full(len(run.t), int(status))
        facts = dict(data_of(page(dataclasses.replace(run, **{name: most})))["facts"])
        found = [
            said
            for what, said in facts.items()
            if status.name.lower()[:8] in what[-30:].replace(" ", "_")
        ]
        usual = ("OK", "MEASUREMENT_HELD", "UNLIMITED", "FREE")
        assert found == ([] if status.name in usual else ["100 % of the time"]), status


def test_the_page_of_a_path_says_how_far_it_was_left(run):
    x_d = run.x_d + np.linspace(0.0, 0.1, len(run.t))[:, np.newaxis]
    error = np.zeros_like(run.error)
    error[10, 0] = 0.054
    facts = dict(data_of(page(dataclasses.replace(run, x_d=x_d, error=error)))["facts"])
    assert facts["error"] == "up to 54 mm, 0 mm at the end"
    error[-1] = 2e-12
    facts = dict(data_of(page(dataclasses.replace(run, x_d=x_d, error=error)))["facts"])
    assert facts["error"] == "up to 54 mm, below 0.001 mm at the end"


def test_a_page_is_of_the_robot_that_was_loaded(tmp_path):
    arm = aj.load_robot("xarm7")
    assert arm.name != arm.tree.name
    task, q = aj.PositionTask(arm), arm.neutral() + 0.3
    run = aj.simulate(aj.Plant(arm), aj.SetpointController(task), task.value(q), q, 0.01, dt=1e-3)
    again = aj.Trajectory.load(run.save(tmp_path / "run.npz"))
    assert "<title>xarm7" in page(again)


@pytest.mark.study
def test_a_page_of_a_panda_is_small(panda):
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    gains = aj.Gains(kp=400.0, kv=80.0, damping=1.0)
    controller = aj.SetpointController(aj.PositionTask(belief), gains)
    target = plant.sensor.value(START) + [0.1, -0.15, 0.16]
    text = page(aj.simulate(plant, controller, target, START, 1.0, dt=2e-3))
    data = data_of(text)
    assert len(text.encode()) < 4e6
    assert len(column(data, "t")) == 61
    # what both arms have in common is sent once: all but the object
    assert len(data["clones"]) == len(data["links"]) - 1
    assert data["missing"] == []


def test_missing_meshes_are_told(panda, tmp_path):
    lost = aj.Robot(panda.urdf.replace("package://", "package://no_such_place/"), tip=panda.tip)
    task = aj.PositionTask(lost)
    controller = aj.SetpointController(task, aj.Gains(60.0, 20.0, 1.0))
    run = aj.simulate(aj.Plant(lost, task), controller, task.value(START), START, 0.1, dt=0.01)
    data = data_of(page(run))
    assert any("link0" in text and "no such file" in text for text in data["missing"])
    assert len(data["links"]) > 5  # capsules


def test_a_run_without_a_scene_is_refused(run):
    with pytest.raises(aj.InvalidInputError, match="run must have a scene"):
        page(dataclasses.replace(run, scene=None))


def test_a_file_that_cannot_be_written_is_told(run, tmp_path):
    with pytest.raises(aj.InvalidInputError, match="path must be a file that can be written"):
        view.save_page(run, tmp_path / "no" / "such" / "folder.html")


def test_a_run_of_a_file_has_the_same_page(run, tmp_path):
    assert page(aj.Trajectory.load(run.save(tmp_path / "run"))) == page(run)


def test_without_meshcat_it_says_what_to_install(run, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "meshcat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "meshcat", None)
    with pytest.raises(aj.errors.ApproxJacError, match=r"pip install 'approxjac\[view\]'"):
        page(run)


@pytest.mark.parametrize("there", [True, False])
def test_a_run_is_viewed(run, monkeypatch, capsys, there):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or there)
    path = view.show(run, "seen")
    try:
        assert opened == [path.as_uri()]
        assert path.read_text(encoding="utf-8") == page(run, title="seen")
        told = capsys.readouterr().out
        assert told == ("" if there else f"No browser could be opened here: the page is {path}\n")
    finally:
        path.unlink()


def test_without_a_screen_no_browser_is_tried(run, monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(webbrowser, "open", None)  # one for terminals would take this one over
    path = view.show(run)
    path.unlink()
    assert capsys.readouterr().out == f"No browser could be opened here: the page is {path}\n"


def test_a_run_that_cannot_be_viewed_leaves_no_file(run, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(aj.InvalidInputError, match="run must have a scene"):
        view.show(dataclasses.replace(run, scene=None))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("length", [0.0, 0.15])
def test_the_legend_names_an_object_where_one_is_held(length):
    arm = aj.load_robot("two_link").with_object(length)
    task = aj.PositionTask(arm, axes="xz")
    held = aj.simulate(
        aj.Plant(arm, task), aj.SetpointController(task), (0.5, 1.2), (0.3, 0.8), 0.004, dt=2e-3
    )
    named = {entry[0] for entry in data_of(page(held))["legend"]}
    assert ("object" in named) == (length > 0.0)
    assert "arm" in named
    assert "wall" not in named
