"""The built documentation, opened from a folder in a browser that has no network.

Build it with `sphinx-build -W docs docs/_build`; without a build these tests are skipped, and
where APPROXJAC_NEEDS_SITE is set, as in CI after the build, they fail.
"""

import os
from pathlib import Path
from urllib.parse import unquote, urldefrag

import numpy as np
import pytest
from lxml import html
from pictures import pixels

pytestmark = pytest.mark.site
SITE = (Path(__file__).parents[1] / "docs" / "_build").resolve()
TARGETS = {"a": "href", "img": "src", "link": "href", "script": "src", "source": "src"}
PLAIN = ("genindex", "search", "py-modindex")  # pages that Sphinx adds


def built():
    if SITE.joinpath("index.html").exists():
        return
    if os.environ.get("APPROXJAC_NEEDS_SITE"):
        pytest.fail("APPROXJAC_NEEDS_SITE is set, but docs/_build has no site")
    pytest.skip("the site is not built: sphinx-build -W docs docs/_build")


@pytest.fixture(scope="module")
def pages():
    """Pages of the site by path, parsed; those of runs are programs, and stand in `RUNS`."""
    built()
    paths = [path for path in SITE.rglob("*.html") if "_static" not in path.parts]
    written = [path for path in paths if "runs" not in path.relative_to(SITE).parts]
    return {path: html.parse(str(path)).getroot() for path in sorted(written)}


def is_outside(link):
    return link.startswith(("http:", "https:", "mailto:", "data:"))


def test_every_link_and_picture_leads_to_something_that_is_there(pages):
    ids = {path: set(root.xpath("//@id")) for path, root in pages.items()}
    broken = []
    for path, root in pages.items():
        for tag, attribute in TARGETS.items():
            for link in root.xpath(f"//{tag}/@{attribute}"):
                if is_outside(link):
                    # a page may lead into the net; what it is made of may not come from there
                    if tag != "a" and not link.startswith("data:"):
                        broken.append(f"{path.name} loads {link}")
                    continue
                name, anchor = urldefrag(link)
                name = unquote(name.split("?")[0])
                goal = (path.parent / name).resolve() if name else path
                if not goal.exists():
                    broken.append(f"{path.name}: {link}")
                elif anchor and goal in ids and unquote(anchor) not in ids[goal]:
                    broken.append(f"{path.name}: {link} has no such place")
    assert broken == []


def test_every_page_is_reached_from_the_navigation(pages):
    index = SITE / "index.html"
    links = pages[index].xpath("//aside//a[contains(@class, 'reference internal')]/@href")
    reached = {(SITE / urldefrag(link)[0]).resolve() for link in links} | {index}
    own = {path for path in pages if path.stem not in PLAIN}
    assert {path.relative_to(SITE).as_posix() for path in own - reached} == set()


def test_types_are_named_as_in_the_source(pages):
    text = pages[SITE / "api" / "interface.html"].xpath("string(//article)")
    assert "ndarray" not in text
    assert "q (Array) – Joint configuration" in " ".join(text.split())


def test_a_picture_leads_to_its_file(pages):
    alone = [
        f"{path.name}: {image.get('src')}"
        for path, root in pages.items()
        for image in root.xpath("//article//img")
        if image.getparent().tag != "a" and path.name != "gallery.html"  # whose cards are links
    ]
    assert alone == []


def test_no_formula_is_left_as_source(pages):
    formulas = 0
    for path, root in pages.items():
        formulas += len(root.xpath("//math"))
        for code in root.xpath("//script | //style | //pre | //code"):
            code.drop_tree()
        text = root.xpath("string(//article)")
        left = [source for source in ("\\frac", "\\hat", "$$") if source in text]
        assert left == [], path.name
    assert formulas > 100


def test_a_reader_finds_the_way_by_the_navigation(pages, open_page):
    page = open_page(SITE / "index.html")
    page.context.set_offline(True)
    links = page.locator("aside .sidebar-tree a.reference.internal")
    names = links.evaluate_all("links => links.map(link => link.href)")
    assert len(names) > 20
    for name in names[:: max(1, len(names) // 5)]:
        page.goto((SITE / "index.html").as_uri())
        page.evaluate(
            "name => [...document.querySelectorAll('aside .sidebar-tree a')]"
            ".find(link => link.href === name).click()",
            name,
        )
        page.wait_for_url(name)
        assert page.locator("article h1").first.is_visible()
        assert page.locator("aside .sidebar-tree .current").count() > 0


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("Lyapunov", "theory.html"),
        ("TorqueLimited", "api/controllers.html"),
        ("camera roll", "visual_servoing.html"),
    ],
)
def test_the_search_finds_and_leads_there(pages, open_page, words, wanted):
    page = open_page(SITE / "index.html")
    box = page.locator("input[name=q]").first
    box.fill(words)
    box.press("Enter")
    page.wait_for_url("**/search.html**")
    results = page.locator("#search-results li a")
    # each has a few words around what was found, in a folder without a network, too
    page.locator("#search-results li .context").first.wait_for()
    # they come in one by one
    page.locator(f"#search-results li a[href*='{wanted}']").first.wait_for()
    results.first.click()
    page.locator("article h1").first.wait_for()
    assert "search.html" not in page.url


def test_formulas_and_pictures_are_drawn(pages, open_page):
    drawn = [path for path, root in pages.items() if root.xpath("//math | //article//img")]
    page = open_page(drawn[0])
    for path in drawn:
        page.goto(path.as_uri())
        broken = page.evaluate(
            "() => [...document.images].filter(image => !image.naturalWidth)"
            ".map(image => image.src)"
        )
        assert broken == []
        # of a formula that the browser could not lay out, nothing would be left to see
        boxes = page.evaluate(
            "() => [...document.querySelectorAll('article math')].map(formula => {"
            " const box = formula.getBoundingClientRect(); return [box.width, box.height]})"
        )
        assert all(width > 3 and height > 6 for width, height in boxes), path.name
        wide = page.evaluate(
            "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )
        assert wide <= 0, f"{path.name} is {wide} px wider than the window"


def test_the_animated_pages_play(pages, open_page):
    linked = {
        (path.parent / urldefrag(link)[0]).resolve()
        for path, root in pages.items()
        for link in root.xpath("//a/@href")
        if link.startswith("runs/")
    }
    runs = sorted(path for path in (SITE / "runs").rglob("*.html") if path.name != "index.html")
    assert len(runs) >= 10
    listed = set()
    for index in (SITE / "runs").rglob("index.html"):
        assert index in linked, f"no page leads to {index.relative_to(SITE)}"
        root = html.parse(str(index)).getroot()
        listed |= {(index.parent / link).resolve() for link in root.xpath("//a/@href")}
    assert set(runs) <= listed | linked
    for path in runs[:: len(runs) - 1]:  # of an example, and of the study
        page = open_page(path, (800, 600), motion="no-preference")
        page.wait_for_function("approxjac.state().t > 0.1", timeout=20_000)  # it plays by itself
        page.evaluate("approxjac.pause()")
        page.wait_for_timeout(200)
        assert len(np.unique(pixels(page).reshape(-1, 3), axis=0)) > 500
