"""A run in the browser while it goes on: shown as it is, following the user, ending cleanly."""

import asyncio
import dataclasses
import json
import re
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenarios import camera
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

import approxjac as aj
from approxjac import view
from approxjac.cameras import PlanarCamera
from approxjac.controllers import RegressorGravity
from approxjac.robots import GravityRegressor
from approxjac.scenario import build_scenario, run_scenario
from approxjac.view.browser import live as live_module

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
LENGTH = 0.2


@pytest.fixture(scope="module")
def panda(panda):
    """A Panda drawn as capsules: simplifying its meshes takes a second for every run."""
    return aj.Robot(panda.urdf.replace("/visual/", "/gone/"), tip=panda.tip)


@pytest.fixture(autouse=True)
def no_browser_of_the_user(monkeypatch):
    monkeypatch.setattr("approxjac.view.browser.live.open_browser", lambda url: False)


def parts(arm):
    truth, belief = arm.with_object(LENGTH, 0.5, axis="x"), believing(arm)(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    regressor = GravityRegressor(belief)
    gravity = RegressorGravity(regressor, regressor.fit(truth)[0])
    gains = aj.Gains(kp=600.0, kv=80.0, damping=1.0)
    controller = aj.SetpointController(aj.PositionTask(belief), gains, gravity=gravity)
    return plant, controller, plant.sensor.value(START) + [0.05, -0.1, 0.05]


def learning(task):
    return aj.SetpointController(task, gravity=aj.AdaptiveGravity(GravityRegressor(task.robot)))


def believing(arm):
    return lambda length: arm.with_object(length, 0.0, axis="x")


def simulate(arm, observer=None, duration=0.3, **options):
    plant, controller, target = parts(arm)
    return aj.simulate(
        plant, controller, target, START, duration, dt=1e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"), observer=observer, **options,
    )  # fmt: skip


class Running:
    """A run in a thread of its own, as a program of the user's would have it."""

    def __init__(self, arm, live, duration=60.0):
        self.live, self.result, self.error = live, None, None
        self._thread = threading.Thread(target=self._run, args=(arm, duration))
        self._thread.start()
        wait_for(lambda: live.url is not None or self.error is not None)

    def __call__(self, loop):
        self._loop = loop
        self.live(loop)

    def __enter__(self):
        return self.live.__enter__()

    def __exit__(self, *error):
        self.live.__exit__(*error)

    def _run(self, arm, duration):
        try:
            self.result = simulate(arm, self, duration, record_every=0.01)
        except Exception as error:  # told in the test's own thread
            self.error = error

    def stop(self):
        self._loop.stop()
        self._thread.join(20.0)

    def ended(self):
        self._thread.join(20.0)
        assert not self._thread.is_alive()
        assert self.error is None
        return self.result


@pytest.fixture
def start(panda):
    """Starts runs of a Panda, and stops those that a test has left running."""
    started = []

    def start_(live):
        started.append(Running(panda, live))
        return started[-1]

    yield start_
    for running in started:
        running.stop()


def wait_for(condition, seconds=20.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "it did not happen in time"
        time.sleep(0.02)


def last(page, name):
    return np.array(page.evaluate(f"approxjac.column('{name}').at(-1)"))


def on_screen(page, point):
    at = page.evaluate("point => approxjac.project(point)", list(map(float, point)))
    return np.array([at["x"], at["y"]])


# -- in a browser -------------------------------------------------------------------------------


def test_the_arm_follows_a_target_moved_in_the_page(panda, open_page, start):
    live = view.LiveView(believe=believing(panda), patience=30.0)
    running = start(live)
    page = open_page(live.url)
    page.wait_for_function("approxjac.state().length > 20")
    before = last(page, "target")
    # as numbers
    field = page.locator("#live-target-y")
    field.fill(f"{before[1] + 0.12:.3f}")
    field.press("Enter")
    page.wait_for_function(
        f"Math.abs(approxjac.column('target').at(-1)[1] - {before[1] + 0.12}) < 2e-3"
    )
    wanted = last(page, "target")
    assert_allclose(wanted[[0, 2]], before[[0, 2]], atol=2e-3)
    page.wait_for_function("""() => {
        const [tip, target] = ["tip", "target"].map((name) => approxjac.column(name).at(-1));
        return Math.hypot(...tip.map((x, i) => x - target[i])) < 0.01;
    }""")
    # with the mouse: what is dragged is where the mouse is
    x, y = on_screen(page, wanted)
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(x - 12 * step, y + 8 * step)
    page.mouse.up()
    moved = f"approxjac.column('target').at(-1).map((v, i) => v - {wanted.tolist()}[i])"
    page.wait_for_function(f"Math.hypot(...{moved}) > 0.02")
    released = [x - 60, y + 40]
    wait_for(lambda: np.abs(on_screen(page, last(page, "target")) - released).max() < 4.0)
    dragged = last(page, "target")
    page.wait_for_function("""() => {
        const target = approxjac.column("target").at(-1);
        return approxjac.column("tip").slice(-30).every(  // and stays
            (tip) => Math.hypot(...tip.map((x, i) => x - target[i])) < 0.01);
    }""")
    ghost = last(page, "believed_tip")
    assert np.linalg.norm(ghost - dragged) > 0.5 * LENGTH  # the ghost's tip is not there
    assert np.linalg.norm(last(page, "tip") - dragged) < 0.01
    page.get_by_role("button", name="Stop the run").click()
    run = running.ended()
    assert_allclose(run.target, dragged, atol=1e-4)
    assert run.error_norm[-1] < 0.012
    assert len(np.unique(run.x_d, axis=0)) >= 3  # first, typed, dragged
    page.wait_for_selector("text=The run has ended")


@pytest.mark.long
def test_the_run_of_a_robot_is_shown_and_its_target_moved(panda, open_page):
    plant, controller, target = parts(panda)
    limited = aj.TorqueLimited(controller, aj.Limits(effort=panda.effort_limits))
    driver = aj.realtime.SimulatedDriver(plant, START, pace=0.1)  # on a busy machine, too
    live, stop = view.LiveView(patience=30.0), threading.Event()
    with ThreadPoolExecutor() as pool:
        running = pool.submit(
            aj.control, driver, limited, target, 60.0, observer=live, stop=stop,
            tolerances=aj.realtime.Tolerances(max_period=5.0),
        )  # fmt: skip
        wait_for(lambda: live.url is not None or running.done())
        page = open_page(live.url)
        page.wait_for_function("approxjac.state().length > 20")
        y = round(last(page, "target")[1] + 0.05, 3)
        field = page.locator("#live-target-y")
        field.fill(f"{y:.3f}")
        field.press("Enter")  # the target has come to rest there, so that a stop leaves it
        page.wait_for_function(f"Math.abs(approxjac.column('target').at(-1)[1] - {y}) < 1e-8")
        stop.set()
        run = running.result(20.0)
    assert run.fault is None
    assert driver.braked
    assert abs(run.x_d[-1][1] - y) < 1e-4
    page.wait_for_selector("text=The run has ended")


@pytest.mark.long
def test_a_wrong_length_is_changed_while_it_runs(panda, open_page, start):
    live = view.LiveView(believe=believing(panda), patience=30.0)
    running = start(live)
    page = open_page(live.url)
    page.wait_for_function("approxjac.state().length > 10")
    tips = page.evaluate("['tip', 'believed_tip'].map((name) => approxjac.column(name).at(-1))")
    assert_allclose(np.linalg.norm(np.subtract(*tips)), LENGTH, atol=1e-5)
    slider = page.locator("#live-length")
    slider.fill("0.15")
    page.wait_for_function("""() => {
        const [tip, ghost] = ["tip", "believed_tip"].map((name) => approxjac.column(name).at(-1));
        return Math.abs(Math.hypot(...tip.map((x, i) => x - ghost[i])) - 0.05) < 1e-3;
    }""")
    # the object's mesh is as long as it is believed, too
    long = page.evaluate("""() => {
        const ghost = approxjac.viewer.scene_tree.find(["believed"]).object;
        let found = null;
        ghost.traverse((node) => { if (node.name === "link object") found = node; });
        const box = new MeshCat.THREE.Box3().setFromObject(found);
        return box.getSize(new MeshCat.THREE.Vector3()).length();
    }""")
    assert 0.14 < long < 0.2
    page.get_by_role("button", name="Stop the run").click()
    assert running.ended().scene.belief == believing(panda)(0.15)


def test_pause_speed_reload_and_what_cannot_be(panda, open_page, start):
    live = view.LiveView(patience=30.0)
    running = start(live)
    page = open_page(live.url)
    page.wait_for_function("approxjac.state().length > 10")
    assert page.locator("#live-length").count() == 0  # nobody said how to believe another one
    page.get_by_role("button", name="Pause the run").click()
    page.wait_for_selector("text=Go on")
    times = []

    def rests():  # instants that were on their way arrive first
        page.wait_for_timeout(300)
        times.append(page.evaluate("approxjac.column('t').at(-1)[0]"))
        return len(times) > 1 and times[-1] == times[-2]

    wait_for(rests)
    t = times[-1]
    # a page that is opened late, or anew, has all of it
    length = page.evaluate("approxjac.state().length")
    page.reload()
    page.wait_for_function(f"approxjac.state().length >= {length}")
    assert page.evaluate("approxjac.column('t')[0][0]") == 0.0
    page.get_by_role("button", name="Go on").click()
    page.wait_for_function(f"approxjac.column('t').at(-1)[0] > {t}")
    field = page.locator("#live-speed")
    field.fill("-1")
    field.press("Enter")
    page.wait_for_selector("text=speed must be a finite number >= 0.001")
    page.get_by_role("button", name="Stop the run").click()
    running.ended()


@pytest.mark.long  # by part: of a pixel below, of dragging in test_page.py
def test_a_target_is_moved_in_the_image(open_page):
    """A camera that is rolled, images that come late; the point follows its new target."""
    ready = build_scenario(camera(
        believed={"camera": {"roll": 0.3}}, sensor={"noise": 0.0}, loop={"dt": 0.001},
        run={"duration": 60.0, "seed": 2},
    ))  # fmt: skip
    live, results = view.LiveView(believe=ready.believe, patience=30.0), []
    thread = threading.Thread(target=lambda: results.append(run_scenario(ready, observer=live)))
    thread.start()
    wait_for(lambda: live.url is not None)
    page = open_page(live.url)
    page.wait_for_function("approxjac.state().length > 20")
    wanted = (np.array(page.evaluate("approxjac.column('target_pixels').at(-1)")) + 30.0).tolist()
    page.evaluate("x => approxjac.onpixel(0, x)", wanted)  # as dragging does: test_page.py
    page.wait_for_function(f"""() => {{
        const pixels = approxjac.column("pixels").at(-1), target = {wanted};
        return Math.hypot(...pixels.map((x, i) => x - target[i])) < 3;
    }}""")
    page.evaluate("approxjac.onpixel(0, [-5000, 100])")
    page.wait_for_selector("text=target must be within the image")
    page.get_by_role("button", name="Stop the run").click()
    thread.join(20.0)
    assert_allclose(results[0].run.target, wanted, rtol=1e-5)


# -- without one --------------------------------------------------------------------------------


def held(task):
    limited = aj.TorqueLimited(aj.SetpointController(task), aj.Limits(effort=60.0, rate=2000.0))
    return aj.HeldMeasurement(limited, 0.2)


SENSING = aj.Sensing(x_noise=1e-3, x_rate=100.0, x_delay=0.01, x_dropout=0.2, velocity_filter=0.01)


@pytest.mark.parametrize(
    ("engine", "controller_of", "sensing"),
    [(aj.Plant, learning, None), (aj.MujocoPlant, held, SENSING)],
    ids=["learning", "held"],
)
def test_a_view_changes_no_bit(panda, engine, controller_of, sensing):
    """Real sensors, limits and another engine included; and every step is dt after the last one."""
    truth = panda.with_object(LENGTH, 0.5, axis="x")
    plant = engine(truth, aj.PositionTask(truth), sensing=sensing)
    controller = controller_of(aj.PositionTask(believing(panda)(0.0)))
    target = plant.sensor.value(START) + [0.05, -0.1, 0.05]

    def run(observer=None):
        return aj.simulate(plant, controller, target, START, 0.25, dt=1e-3, observer=observer)

    alone, shown = run(), run(view.LiveView(speed=np.inf, patience=0.0))
    names = [
        f.name for f in dataclasses.fields(alone) if f.name not in ("scene", "derived", "engine")
    ]
    for name in (*names, "V", "task_torque"):
        assert_array_equal(getattr(alone, name), getattr(shown, name), err_msg=name)
    assert_allclose(np.diff(shown.t), 1e-3, rtol=1e-9)


def test_the_view_keeps_the_time_that_it_is_told(panda):
    began = time.perf_counter()
    shown = simulate(panda, view.LiveView(speed=3.0, patience=0.0))
    assert time.perf_counter() - began >= shown.t[-1] / 3.0  # never faster


def test_a_run_that_was_stalled_does_not_sprint(panda):
    live, times = view.LiveView(patience=0.0), []

    def stall(loop):
        live(loop)
        times.append(time.perf_counter())
        if loop.step == 50:
            time.sleep(0.8)

    simulate(panda, stall, duration=0.25)
    live.close()
    assert times[-1] - times[51] >= 0.15  # 0.2 s of the run, which would else take none


def pages_served():
    return [thread for thread in threading.enumerate() if thread.name == "approxjac page"]


def is_served(url):
    try:
        socket.create_connection(("127.0.0.1", port_of(url)), timeout=1.0).close()
    except OSError:
        return False
    return True


def port_of(url):
    return urlsplit(url).port


def test_it_ends_cleanly(panda):
    live = view.LiveView(speed=np.inf, patience=0.0)
    simulate(panda, live)
    assert not is_served(live.url)
    assert pages_served() == []
    live.close()  # again does nothing
    with pytest.raises(aj.InvalidInputError, match="a LiveView is for one run"):
        simulate(panda, live)


def test_it_ends_with_a_run_that_is_broken_off(panda):
    class Breaking(view.LiveView):
        def __call__(self, loop):
            super().__call__(loop)
            assert is_served(self.url)
            raise KeyboardInterrupt

    live = Breaking(speed=np.inf, patience=0.0)
    with pytest.raises(KeyboardInterrupt):
        simulate(panda, live)
    assert not is_served(live.url)
    assert pages_served() == []


def test_a_port_that_is_taken(panda):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(
            aj.InvalidInputError, match=f"port must be free, or left out .* got {port}"
        ):
            simulate(panda, view.LiveView(port=port, patience=0.0))


def test_the_usual_port_may_be_taken(panda, monkeypatch, capsys):
    with socket.socket() as usual:
        usual.bind(("127.0.0.1", 0))
        usual.listen()
        taken = usual.getsockname()[1]
        monkeypatch.setattr(live_module, "_PORT", taken)
        live = view.LiveView(speed=np.inf, patience=0.0)
        simulate(panda, live)
        assert port_of(live.url) != taken
        assert f"(port {taken} is taken)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"port": 0}, "port must be a number from 1 to 65535, got 0"),
        ({"port": "web"}, "port must be a number from 1 to 65535, got 'web'"),
        ({"speed": 0.0}, "speed must be a finite number >= 0.001, got 0.0"),
        ({"speed": -np.inf}, "speed must be a finite number >= 0.001"),
        ({"patience": -1.0}, r"patience must be a finite number >= 0 \[s\]"),
        ({"believed_length": np.nan}, r"believed_length must be a finite number >= 0 \[m\]"),
    ],
)
def test_what_cannot_be_is_refused(panda, options, message):
    with pytest.raises(aj.InvalidInputError, match=message):
        simulate(panda, view.LiveView(**{"patience": 0.0, **options}))


def test_a_controller_that_cannot_believe_anything_else_is_refused(panda):
    plant, own, target = parts(panda)

    class Nothing(aj.Controller):
        def advance(self, state, measurement, target, dt):
            e = measurement.x - target
            return state, aj.Evaluation(np.zeros(7), np.zeros(0), aj.Status.OK, e)

    live = view.LiveView(believe=believing(panda), patience=0.0)
    with pytest.raises(aj.InvalidInputError, match="with_task"):
        aj.simulate(plant, Nothing(own.task), target, START, 0.01, dt=1e-3, observer=live)
    # it is shown all the same where nothing is to be changed
    live = view.LiveView(speed=np.inf, patience=0.0)
    aj.simulate(plant, Nothing(own.task), target, START, 0.01, dt=1e-3, observer=live)


class Pages:
    """What browsers do, without one."""

    def __init__(self, url):
        self.url = url

    def get(self, host=None):
        headers = {} if host is None else {"Host": host}
        with urlopen(Request(self.url, headers=headers)) as answer:
            return answer.read().decode()

    def tell(self, *messages, until="rows", headers=None):
        """Open a socket, send messages, and return the first one that is got with such a part."""

        async def talk():
            url = self.url.replace("http", "ws") + "socket"
            socket = await websocket_connect(HTTPRequest(url, headers=headers or {}))
            for message in messages:
                await socket.write_message(message)
            while until not in (got := json.loads(await socket.read_message())):
                pass
            socket.close()
            while await socket.read_message() is not None:
                pass  # until it is closed
            return got

        # Playwright has an event loop in this thread
        with ThreadPoolExecutor() as pool:
            return pool.submit(asyncio.run, talk()).result(20.0)


def with_pages(arm, act, **options):
    """Run for as long as `act` takes with the pages of the run."""
    live = view.LiveView(patience=0.0, **options)
    running = Running(arm, live)
    try:
        act(Pages(live.url), running)
        Pages(live.url).tell('{"stop": true}', until="ended")
        running.ended()
    finally:
        running.stop()


@pytest.mark.parametrize("axes", ["xyz", "zx", "y"])
def test_a_point_moves_each_axis_of_the_task_to_its_own_place(panda, axes):
    sensor = aj.PositionTask(panda, axes=axes)
    loop = SimpleNamespace(plant=aj.Plant(panda, sensor), target=sensor.value(START))
    place = np.array([0.4, -0.1, 0.5])
    found = live_module._target(loop, "point", place, 1.0)
    assert_array_equal(found, [place["xyz".index(axis)] for axis in axes])
    assert_array_equal(loop.target, sensor.value(START))  # the run's own is left as it is
    for axis in range(3):
        for side in (-1.0, 1.0):
            far = np.where(np.arange(3) == axis, 2.01 * side, 0.1)  # of an arm of 1 m
            with pytest.raises(aj.InvalidInputError, match="target must be at most 2 m from the"):
                live_module._target(loop, "point", far, 1.0)


def test_a_pixel_moves_the_image_of_its_point_alone(panda):
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -0.5, 0.7), 600.0, (640, 480))
    image = aj.ImageTask(panda, camera, points=[[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    sensor = aj.StackedTask(aj.PositionTask(panda, axes="z"), image)
    loop = SimpleNamespace(plant=aj.Plant(panda, sensor), target=sensor.value(START))
    found = live_module._target(loop, "pixel", np.array([1.0, 300.0, 200.0]), 1.0)
    assert_array_equal(found, [*loop.target[:3], 300.0, 200.0])
    for wrong in (-1.0, 2.0, 0.5):
        with pytest.raises(aj.InvalidInputError, match=f"there is no point {wrong:g} in an image"):
            live_module._target(loop, "pixel", np.array([wrong, 300.0, 200.0]), 1.0)


def test_an_image_may_be_moved_about_where_the_base_appears():
    arm = aj.load_robot("two_link")
    sensor = aj.ImageTask(arm, PlanarCamera(0.05, 3.0, offset=(0.5, -0.2)))
    loop = SimpleNamespace(plant=aj.Plant(arm, sensor), target=sensor.value([0.3, 0.8]))
    moved = live_module._target(loop, "pixel", np.array([0.0, 0.51, -0.21]), 1.0)
    assert_allclose(moved, [0.51, -0.21])
    for far in ([0.0, 0.0], [0.56, -0.2], [0.5, -0.26]):
        with pytest.raises(aj.InvalidInputError, match="from where the base appears"):
            live_module._target(loop, "pixel", np.array([0.0, *far]), 1.0)


def test_a_run_goes_on_at_its_speed_from_where_it_is(panda):
    """Whatever its speed was before: what is over counts for nothing."""
    live, loop = view.LiveView(speed=4.0), SimpleNamespace(t=2.0)
    for speed in (4.0, 0.5):
        live._speed = speed
        began = time.perf_counter()
        live._begin(loop)
        due = live._origin + (loop.t + 0.3) / speed
        assert due - began == pytest.approx(0.3 / speed, abs=0.05)


def test_what_a_page_sends_cannot_hurt(panda):
    answers = {
        '{"point": [1' + 400 * "0" + ", 0, 0]}": r"point must be numbers, got \[1000",
        '{"point": "123"}': "point must be numbers, got '123'",
        '{"point": {"0": 1}}': "point must be numbers, got {'0': 1}",
        '{"point": [NaN, 0, 0]}': "point must be finite",
        '{"point": [true, 0, 0]}': "point must be numbers",
        '{"point": ["", 0, 0]}': "point must be numbers",
        '{"point": [1e308, 1e308, 1e308]}': "target must be at most .* m from the arm's base",
        '{"point": [1e300, 0, 0]}': "target must be at most .* m from the arm's base",
        '{"point": [0.3, 0.3, 1e30]}': "target must be at most .* m from the arm's base",
        '{"point": [1, 2]}': r"point must have shape \(3,\)",
        '{"pixel": [0, 1, 2]}': "there is no point 0 in an image",
        '{"length": true}': "length must be numbers",
        '{"length": -1}': r"length must be a finite number >= 0 and <= .* \[m\], got -1.0",
        '{"length": 1e300}': r"length must be a finite number >= 0 and <= .* \[m\], got 1e\+300",
        '{"length": 0.7}': "length: ZeroDivisionError",
        '{"pixel": []}': r"pixel must have shape \(3,\)",
        '{"speed": 1e-308}': "speed must be a finite number >= 0.001, got 1e-308",
        '{"speed": 1' + 400 * "0" + "}": "speed must be numbers",
        '{"<b>": 1}': "commands are: .* got '<b>'",
    }

    def believe(length):
        return believing(panda)(length) if length < 0.5 else 1 / 0

    def act(pages, running):
        for message, answer in answers.items():
            note = pages.tell("[" * 15_000, "no json", "[1]", message, until="note")["note"]
            assert re.search(answer, note), message[:24]
            assert len(note) < 400
        assert running.error is None

    with_pages(panda, act, believe=believe)


def test_only_this_machine_by_its_own_name_is_served(panda):
    def act(pages, _):
        for host in ("evil.example", "evil.example:7007"):
            with pytest.raises(HTTPError, match="404"):
                pages.get(host)
            with pytest.raises(HTTPClientError, match="404"):
                pages.tell('{"stop": true}', headers={"Host": host, "Origin": f"http://{host}"})
        assert "</html>" in pages.get(f"localhost:{port_of(pages.url)}")

    with_pages(panda, act)


def test_it_is_served_with_the_policy_of_its_page_and_in_no_frame(panda):
    def act(pages, _):
        with urlopen(pages.url) as answer:
            policy, text = answer.headers["Content-Security-Policy"], answer.read().decode()
        own, _, frames = policy.rpartition("; ")
        assert f'http-equiv="Content-Security-Policy" content="{own}"' in text
        assert "connect-src ws://127.0.0.1:* ws://localhost:*;" in own
        assert frames == "frame-ancestors 'none'"

    with_pages(panda, act)


def test_without_the_key_of_its_address_nobody_is_served(panda):
    def act(pages, _):
        bare = Pages(f"http://127.0.0.1:{port_of(pages.url)}/")
        with pytest.raises(HTTPError, match="403") as refused:
            bare.get()
        assert "Open the address that the program printed" in refused.value.read().decode()
        for address in (bare.url, f"{bare.url}wrong/"):
            for headers in ({}, {"Origin": bare.url.rstrip("/")}):
                with pytest.raises(HTTPClientError, match="404"):
                    Pages(address).tell('{"stop": true}', headers=headers)
        # nor are pages of others that know it
        with pytest.raises(HTTPClientError, match="403"):
            pages.tell('{"stop": true}', headers={"Origin": "http://evil.example"})
        pages.tell(headers={"Origin": bare.url.rstrip("/")})
        pages.tell()

    with_pages(panda, act)


@pytest.mark.long
def test_a_flood_of_messages_does_not_hold_up_a_run(panda):
    """Of each kind of wish the latest is obeyed; a page that sends too many waits, not the run."""
    sent, done = 143_000, threading.Event()

    async def flood(url):
        connection = await websocket_connect(url.replace("http", "ws") + "socket")
        for i in range(sent):
            connection.write_message(json.dumps({f"wish {i % 100}": i, "pixel": [i % 100, 0, 0]}))
            if i % 200 == 0:
                await asyncio.sleep(0.0)
            if done.is_set():
                break
        connection.close()
        while await connection.read_message() is not None:
            pass  # until it is closed
        return i

    def act(pages, running):
        with ThreadPoolExecutor() as pool:
            flooding = pool.submit(asyncio.run, flood(pages.url))
            time.sleep(0.3)
            assert len(running.live._server._commands) <= 32
            steps = running._loop.step
            latest = time.perf_counter() + 10.0  # on a busy machine; on a quiet one it is 0.05 s
            while running._loop.step <= steps + 50 and time.perf_counter() < latest:
                time.sleep(0.01)
            assert running._loop.step > steps + 50
            began = time.perf_counter()
            pages.tell('{"speed": 2.0}', until="controls")
            assert time.perf_counter() - began < 3.0
            done.set()
            flooding.result(30.0)

    with_pages(panda, act)


def test_a_page_opened_while_the_belief_changes_has_the_new_one(panda):
    """Whether it was made before the change or is made after it."""

    def origin(found):
        joints = {joint["path"][-1]: joint["origin"] for joint in found["joints"]["believed"]}
        return joints["link object_tip"][12]

    def data_of(page):
        return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))

    def act(pages, _):
        first = pages.get()
        pages.tell('{"length": 0.15}', until="redraw")
        assert origin(data_of(first)) == 0.0
        # that page opens its socket only now
        assert origin(pages.tell(until="redraw")["redraw"]) == pytest.approx(0.15)
        assert origin(data_of(pages.get())) == pytest.approx(0.15)

    with_pages(panda, act, believe=believing(panda))


def test_while_paused_what_is_changed_is_shown(panda):
    def act(pages, _):
        pages.tell('{"pause": true}')
        wait_for(lambda: pages.tell(until="controls")["controls"]["paused"])
        times = []
        for height in (0.5, 0.45, 0.4):
            target = [*pages.tell()["rows"][-1]["target"][:2], height]
            pages.tell(json.dumps({"point": target}), until="controls")
            wait_for(lambda wanted=target: pages.tell()["rows"][-1]["target"] == wanted)
            rows = pages.tell()["rows"]
            times.append(rows[-1]["t"])
            assert len({row["t"] for row in rows}) == len(rows)
        assert len(set(times)) == 1  # the run stands still meanwhile

    with_pages(panda, act)
