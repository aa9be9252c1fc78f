"""The index page of the run pages in a folder."""

import re
from urllib.parse import unquote

import pytest
from PIL import Image

import approxjac as aj
from approxjac import view
from approxjac.view.browser.page import policy_of

PAGE = """<!doctype html><head><meta name="generator" content="approxjac">
<meta name="description" content="error: 3 &lt; 4"><title>{}</title></head>"""


def test_it_links_the_pages_of_runs_in_their_order(tmp_path):
    names = ["fig10.html", "fig9.html", "run #1 100%.html", "ünï.html", "1²2.html"]
    for name in names:
        (tmp_path / name).write_text(PAGE.format(f"Run &amp; {name}"), encoding="utf-8")
    (tmp_path / "fig9.png").touch()
    (tmp_path / "other.html").write_text("<title>not ours</title>")
    (tmp_path / "latin.html").write_bytes(b"<title>\xe9</title>")
    index = view.write_index(tmp_path, "Runs <of mine>")
    text = index.read_text(encoding="utf-8")
    assert "<title>Runs &lt;of mine&gt;</title>" in text
    links = [unquote(link) for link in re.findall(r'href="(.*?)"', text)]
    assert links == ["1²2.html", "fig9.html", "fig10.html", "run #1 100%.html", "ünï.html"]
    assert "<b>Run &amp; fig9.html</b><p>error: 3 &lt; 4</p>" in text
    assert re.findall(r'<img src="(.*?)"', text) == ["fig9.png"]
    assert view.write_index(tmp_path).read_text(encoding="utf-8").count("<li>") == 5
    (tmp_path / "unfinished.png").write_bytes(b"")  # such as of a program that was stopped
    assert view.write_index(tmp_path).read_text(encoding="utf-8").count("<li>") == 5
    assert "script-src 'none'" in policy_of(text)


def test_pictures_without_a_page_stand_among_the_pages(tmp_path, open_page):
    for name in ("fig3.html", "fig10.html"):
        (tmp_path / name).write_text(PAGE.format(f"K_v of {name}"), encoding="utf-8")
    for name in ("fig4 #1.png", "fig10.png"):
        Image.new("RGB", (40, 30)).save(tmp_path / name)
    page = open_page(view.write_index(tmp_path))
    assert page.locator("li b").all_inner_texts() == [
        "Kv of fig3.html",
        "fig4 #1",
        "Kv of fig10.html",
    ]
    assert page.locator("a").count() == 2
    widths = page.locator("img").evaluate_all("all => all.map((i) => i.naturalWidth)")
    assert widths == [40, 40]


def test_a_picture_is_named_by_the_title_of_its_figure(tmp_path):
    (tmp_path / "run.html").write_text(PAGE.format("A run"), encoding="utf-8")
    Image.new("RGB", (40, 30)).save(tmp_path / "of_somebody.png")
    figure, _ = view.new_figure(title="Ĵ < J, and $K_v$")
    view.save_figure(figure, tmp_path / "fig1")
    figure, (ax,) = view.new_figure()
    ax.set_title("One plot")
    view.save_figure(figure, tmp_path / "fig2")
    text = view.write_index(tmp_path).read_text(encoding="utf-8")
    named = ["Ĵ &lt; J, and K_v", "One plot", "of somebody", "A run"]
    assert re.findall("<b>(.*?)</b>", text) == named


def test_links_with_odd_names_open(tmp_path, open_page):
    (tmp_path / "run #1 100%.html").write_text(PAGE.format("Odd"), encoding="utf-8")
    page = open_page(view.write_index(tmp_path))
    page.click("a")
    assert page.title() == "Odd"


def test_a_folder_without_pages_is_refused(tmp_path):
    with pytest.raises(aj.InvalidInputError, match="folder must hold pages"):
        view.write_index(tmp_path)
    with pytest.raises(aj.InvalidInputError, match="folder must"):
        view.write_index(tmp_path / "nowhere")
