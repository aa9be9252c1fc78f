"""A real browser for pages: Chromium without a window, which may not use the network."""

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

ARGUMENTS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


def _absent(what):
    """Skip, or fail where a browser must be there."""
    if os.environ.get("APPROXJAC_NEEDS_BROWSER"):
        pytest.fail(f"APPROXJAC_NEEDS_BROWSER is set, but there is no {what}")
    pytest.skip(f"needs {what}")


@pytest.fixture(scope="session")
def browser():
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


@pytest.fixture
def open_page(browser):
    """Opens a file or an address; at the end nothing must have been complained of or loaded."""
    opened, wrong = [], []

    def open_(where, size=(1000, 700)):
        url = where if str(where).startswith("http") else Path(where).as_uri()
        own = tuple(
            f"{scheme}://{url.split('/')[2]}/" for scheme in ("http", "ws") if url[:4] == "http"
        )
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.on("console", lambda message: wrong.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith(("file:", "data:", "blob:", *own))
                else wrong.append(f"request: {request.url}")
            ),
        )
        page.goto(url)
        opened.append(page)
        return page

    yield open_
    for page in opened:
        page.close()
    assert wrong == []


def pixels(page):
    """What the page looks like, shape (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), dtype=float)


def near(image, xy, colour, radius=8.0, tolerance=0.15):
    """Count pixels of a colour #rrggbb, however brightly lit, around a point of the page."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], dtype=float)
    y, x = np.indices(image.shape[:2])
    part = image[np.hypot(x - xy[0], y - xy[1]) <= radius]
    lit = part[part.max(axis=1, initial=0.0) > 60.0]
    hues = lit / np.linalg.norm(lit, axis=1, keepdims=True)
    return int((np.linalg.norm(hues - wanted / np.linalg.norm(wanted), axis=1) < tolerance).sum())
