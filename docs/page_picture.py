"""A picture of the page of a run, as a browser shows it. Needs Chromium and the extra `test`.

python docs/page_picture.py PAGE.html PICTURE.png SECONDS
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright


def main(page, picture, seconds):
    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=arguments
        )
        shown = browser.new_page(viewport={"width": 1200, "height": 720})
        shown.goto(Path(page).resolve().as_uri())
        shown.evaluate(f"approxjac.pause(); approxjac.seek({float(seconds)})")
        shown.wait_for_timeout(1000)  # until it is drawn
        shown.screenshot(path=picture)
        browser.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
