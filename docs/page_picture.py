"""A picture of the page of a run, as a browser shows it. Needs Chromium and the extra `test`.

The whole page at an instant, or the arm alone, and that in motion too:

    python docs/page_picture.py PAGE.html PICTURE.png SECONDS
    python docs/page_picture.py PAGE.html ARM.webp SECONDS
    python docs/page_picture.py PAGE.html MOVING.webp FROM TO

The moving picture of the README is of example 01:

    python examples/01_panda_with_unknown_tool.py --out .
    python docs/page_picture.py 01_panda_unknown_tool.html docs/images/panda_unknown_tool.webp 0 1.8
"""

import contextlib
import io
import shutil
import sys
from pathlib import Path

from PIL import Image

ARGUMENTS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
]  # fmt: skip
WHOLE, ARM = (1200, 720), (720, 460)
# what stays is the arm and what its colours mean
ALONE = """
    header { border: 0; padding: 6px 10px 2px } h1, #facts, #notes, #plots, footer, #reset, #state
    { display: none } html, body { height: 100% } body { overflow: hidden }
    main { flex: 1; min-height: 0 } #stage { flex: 1; height: auto }
    #legend { justify-content: center; font-size: 13px }
"""
RATE = 14  # frames a second
SLOWER = 2.0  # than it was
HELD = 1.2  # at its end [s]


@contextlib.contextmanager
def opened(size, alone):
    """A function that opens pages in a browser, one after the other, each at rest."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=ARGUMENTS
        )
        shown = browser.new_page(viewport=dict(zip(("width", "height"), size, strict=True)))
        shown.emulate_media(reduced_motion="reduce", color_scheme="light")

        def open_(page):
            shown.goto(Path(page).resolve().as_uri())
            if alone:
                shown.add_style_tag(content=ALONE)
                shown.wait_for_timeout(300)  # until the view has its new size
            return shown

        yield open_
        browser.close()


def at(shown, seconds, wait=700):
    """What a page looks like at an instant, as PNG; by default the view is drawn anew first."""
    shown.evaluate(f"approxjac.pause(); approxjac.seek({float(seconds)})")
    shown.wait_for_timeout(wait)
    return shown.screenshot()


def save(screenshot, picture):
    """Write what `at` gave to a file, in the format of its ending."""
    Image.open(io.BytesIO(screenshot)).convert("RGB").save(picture)


def frames(shown, first, last):
    """Pictures of the arm at instants between two [s]."""
    count = max(2, round(SLOWER * (last - first) * RATE))
    for k in range(count):
        picture = at(shown, first + (last - first) * k / (count - 1), 700 if k == 0 else 120)
        yield Image.open(io.BytesIO(picture)).convert("RGB")


def main(page, picture, first, last=None):
    alone = Path(picture).suffix == ".webp"
    with opened(ARM if alone else WHOLE, alone) as open_:
        shown = open_(page)
        if last is None:
            save(at(shown, first), picture)
            return
        images = list(frames(shown, float(first), float(last)))
    held = [round(1000 / RATE)] * (len(images) - 1) + [round(1000 * HELD)]
    how = {"duration": held, "loop": 0, "quality": 75, "method": 6}
    images[0].save(picture, save_all=True, append_images=images[1:], **how)


if __name__ == "__main__":
    main(*sys.argv[1:])
