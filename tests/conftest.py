import functools
import gc
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from arms import ARMS
from hypothesis import Phase, settings

import approxjac as aj
from approxjac.codegen.backends.machine_code import MachineCode
from approxjac.controllers import setpoint
from approxjac.robots import robot as robots

IN_CI = bool(os.environ.get("CI"))
settings.register_profile("default", deadline=None, derandomize=IN_CI, max_examples=10)
settings.load_profile("default")
settings.register_profile("more", deadline=None, derandomize=IN_CI, max_examples=40)  # for CI
settings.register_profile("many", deadline=None, derandomize=IN_CI, max_examples=60)  # for CI
# For mutants: that a test fails is all that counts, so the example need not become small.
settings.register_profile(
    "mutants",
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
)


@pytest.hookimpl(tryfirst=True)  # before tests are deselected by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that open a browser."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="module", autouse=True)
def _heap() -> None:
    """Leave what earlier files loaded out of garbage collection, as each loop begins with one."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep machine code beside the files of the tests, for all processes of a run."""
    base = tmp_path_factory.getbasetemp()
    shared = base if os.environ.get("PYTEST_XDIST_WORKER") is None else base.parent
    os.environ["APPROXJAC_CACHE"] = str(shared / "machine_code")


WHOLE = MachineCode.of
FEW_STEPS = ("codegen", "controllers", "realtime")
OPTIMISED = ("test_graph.py", "test_loops.py", "test_machine_code.py")


def _quickly(text: str, features: str, effort: int = 0) -> MachineCode:
    return WHOLE(text, features, 0)


@pytest.hookimpl(tryfirst=True)  # before fixtures compile something
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let LLVM optimise for studies and where machine code is what is tested.

    Elsewhere it takes six times as long as it saves, also where many laws are compiled for some
    steps each; the bits are the same.
    """
    runs_little = item.path.suffix == ".md" or item.path.parent.name in FEW_STEPS
    is_study = item.get_closest_marker("study") is not None and not runs_little
    optimised = item.path.name in OPTIMISED or is_study
    MachineCode.of = WHOLE if optimised else _quickly


def _once(rule):
    """Return a rule of gains that answers for equal arguments once: it takes 40 ms of a controller.

    Equal is what pickles to the same bytes: robots by their URDF, whichever test loaded them.
    """
    known = {}

    @functools.wraps(rule)
    def tuned(*given, **options):
        try:
            key = pickle.dumps((given, options))
        except (AttributeError, TypeError, pickle.PicklingError):  # what a test wrote for itself
            return rule(*given, **options)
        if key not in known:
            known[key] = rule(*given, **options)
        return known[key]

    return tuned


setpoint.tuned = _once(setpoint.tuned)  # `tuned` itself, as tests of it call it, stays as it is


def _copied(build):
    """Return a function that builds the model of a URDF once and then copies it, which is quick."""
    known = {}

    def build_model(urdf):
        key = urdf.text, urdf.source
        if key not in known:
            known[key] = build(urdf)
        model, mimic_joints = pin.Model(known[key][0]), known[key][1]
        independent = model if mimic_joints.G is None else pin.Model(mimic_joints.model)
        return model, mimic_joints._replace(model=independent)

    return build_model


robots.build_model = _copied(robots.build_model)


@pytest.fixture(scope="session", params=ARMS)
def arm(request: pytest.FixtureRequest) -> aj.Robot:
    """Five robots that load by name, and with the marker `every_arm` the others."""
    return aj.load_robot(request.param)


@pytest.fixture(scope="session")
def two_link() -> aj.Robot:
    """The paper's arm with its object, a thin rod."""
    return aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")


@pytest.fixture(scope="session")
def panda() -> aj.Robot:
    return aj.load_robot("panda")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that look at what is written beside pictures: drawing both takes a second."""
    from approxjac.view.style import StyledFigure

    monkeypatch.setattr(
        StyledFigure, "savefig", lambda figure, path, **_: Path(path).write_bytes(b"blank")
    )


# -- a real browser for pages: Chromium without a window, which may not use the network ----------

ARGUMENTS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # there is none: only the arm is drawn as if there were
    "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip

# Edges are not smoothed: without a graphics card that takes a third of a page's time.
JAGGED = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, { ...options, antialias: false });
};
"""

STALL = "GPU stall due to ReadPixels"  # said of each picture that goes to the page without a card


def _absent(what):
    """Skip, or fail where a browser must be there."""
    if os.environ.get("APPROXJAC_NEEDS_BROWSER"):
        pytest.fail(f"APPROXJAC_NEEDS_BROWSER is set, but there is no {what}")
    pytest.skip(f"needs {what}")


@pytest.fixture(scope="session")
def browser():
    """Chromium as it is installed on this machine."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
    if path is None:
        _absent("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        _absent("playwright")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def context(browser):
    """What the pages of a file share; one that stays open keeps their process, too."""
    shared = browser.new_context()
    shared.new_page()
    yield shared
    shared.close()


class Pages:
    """Opens files and addresses; in the end nothing must have been complained of or loaded."""

    def __init__(self, context):
        self.context, self.opened, self.wrong = context, [], []

    def __call__(self, where, size=(1000, 700), motion="reduce"):
        """Where motion is not reduced, a page plays when it is opened."""
        url = where if str(where).startswith("http") else Path(where).as_uri()
        own = tuple(
            f"{scheme}://{url.split('/')[2]}/" for scheme in ("http", "ws") if url[:4] == "http"
        )
        viewport, wrong = {"width": size[0], "height": size[1]}, self.wrong
        page = self.context.new_page()
        page.set_viewport_size(viewport)
        page.emulate_media(reduced_motion=motion)
        page.add_init_script(JAGGED)
        page.wait_for_function = functools.partial(wait_for, page)
        page.on(
            "console",
            lambda message: (
                None if STALL in message.text else wrong.append(f"{message.type}: {message.text}")
            ),
        )
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith(("file:", "data:", "blob:", *own))
                else wrong.append(f"request: {request.url}")
            ),
        )
        page.on(
            "websocket",
            lambda opened: (
                None if opened.url.startswith(own) else wrong.append(f"socket: {opened.url}")
            ),
        )
        page.goto(url)
        self.opened.append(page)
        return page

    def close(self):
        for page in self.opened:
            page.close()
        assert self.wrong == []


def wait_for(page, condition, timeout=30_000):
    """Playwright's own evaluates a text inside of a page, which its security policy forbids."""
    for _ in range(timeout // 50):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise TimeoutError(condition)


@pytest.fixture
def open_page(context):
    """Opens pages for a test, see `Pages`."""
    pages = Pages(context)
    yield pages
    pages.close()


@pytest.fixture(scope="module")
def open_pages(context):
    """Opens pages for all tests of a file, see `Pages`."""
    pages = Pages(context)
    yield pages
    pages.close()
