"""The gallery of the site holds every example, and is made of what the examples themselves say."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
HEADER = '''"""An arm that\nwaves.

You will see: a wave.

    pip install 'approxjac[waves]'
    python examples/07_an_arm_waves.py --out results/examples
"""
'''


@pytest.fixture
def gallery(monkeypatch):
    """The extension of Sphinx, which needs no Sphinx but to be called by it."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    yield __import__("gallery")
    for name in ("gallery", "study_figures"):
        sys.modules.pop(name, None)


@pytest.fixture
def waves(tmp_path):
    """An example that makes a picture and two pages, and prints one line more."""
    path = tmp_path / "07_an_arm_waves.py"
    files = ["wave.png", "wave.svg", "wave.html", "wave_ur5.html", "index.html"]
    path.write_text(
        f"{HEADER}import pathlib, sys\nout = pathlib.Path(sys.argv[2])\nout.mkdir()\n"
        f"for name in {files}:\n    (out / name).write_text('')\n    print(out / name)\n"
        "print('|e| 3 -> 0 mm')\nprint(out / 'arm.urdf')\n",
        encoding="utf-8",
    )
    return path


def images(markdown):
    """(alternative text, path) of each picture of a page."""
    return re.findall(r"!\[(.*?)\]\((.*?)\)", markdown)


def test_every_example_has_a_card_and_a_page(gallery, tmp_path):
    assert gallery.examples() == EXAMPLES
    assert len(EXAMPLES) >= 10
    told = [gallery.story(path, f"/somewhere/{path.stem}.png\n") for path in EXAMPLES]
    docs = tmp_path / "docs"
    (docs / "gallery").mkdir(parents=True)
    (docs / "gallery" / "01_an_older_name.md").write_text("# Old\n")
    gallery.write(docs, told)

    assert sorted(path.stem for path in (docs / "gallery").iterdir()) == [
        path.stem for path in EXAMPLES
    ]
    cards = (docs / "_generated" / "gallery.md").read_text(encoding="utf-8")
    links = re.findall(r"^\[(.*?)\]\((.*?)\)$", cards, re.MULTILINE)
    assert [path for _, path in links] == [f"gallery/{path.stem}.md" for path in EXAMPLES]
    assert [title.split(".")[0] for title, _ in links] == [
        str(int(path.stem[:2])) for path in EXAMPLES
    ]
    assert [path for _, path in images(cards)] == [
        f"_generated/examples/{path.stem}.png" for path in EXAMPLES
    ]
    for path, (alt, _) in zip(EXAMPLES, images(cards), strict=True):
        assert len(alt) > 20
        assert alt in " ".join(path.read_text(encoding="utf-8").split())
        page = (docs / "gallery" / f"{path.stem}.md").read_text(encoding="utf-8")
        assert [text for text, _ in images(page)] == [alt]
        assert "You will see:" in page
        assert f"{{literalinclude}} ../../examples/{path.name}\n" in page


def test_an_example_is_run_and_told_by_its_header_and_its_output(gallery, waves, tmp_path):
    out = tmp_path / "out"
    told = gallery.run(waves, out)
    assert told.title == "7. An arm waves"
    assert told.summary == "An arm that waves."
    assert told.text == "You will see: a wave."
    assert told.pictures == [out / "wave.png"]
    assert told.pages == [out / "wave.html", out / "wave_ur5.html"]
    assert told.printed == "|e| 3 -> 0 mm\nresults/examples/arm.urdf"  # no path of this machine

    card, page = gallery.card(told), gallery.page(told)
    assert images(card) == [("An arm that waves.", "_generated/examples/wave.png")]
    assert images(page) == [("An arm that waves.", "../_generated/examples/wave.png")]
    assert '"runs/examples/wave.html">Watch it move<' in card
    assert '"../runs/examples/wave_ur5.html">Watch ur5<' in page
    command = "python examples/07_an_arm_waves.py --out results/examples"
    assert f"```sh\npip install 'approxjac[waves]'\n{command}\n```" in page
    assert "```text\n|e| 3 -> 0 mm\nresults/examples/arm.urdf\n```" in page


def test_a_failing_example_and_one_without_a_picture_stop_the_build(gallery, waves, tmp_path):
    with pytest.raises(RuntimeError, match=r"07_an_arm_waves.py printed no path of a PNG"):
        gallery.story(waves, "|e| 3 -> 0 mm\n")
    waves.write_text(HEADER + "raise SystemExit('the arm is stuck')\n", encoding="utf-8")
    with pytest.raises(RuntimeError, match=r"07_an_arm_waves.py ended with 1:\nthe arm is stuck"):
        gallery.run(waves, tmp_path)


def test_the_index_of_runs_lists_those_of_all_examples(gallery, waves, monkeypatch, tmp_path):
    head = '<meta name="generator" content="approxjac"><title>{}</title>'
    paths = [waves, waves.with_name("08_an_arm_bows.py")]
    paths[1].write_text(HEADER.replace("waves", "bows"), encoding="utf-8")
    for path, name in zip(paths, ("wave", "bow"), strict=True):
        left = tmp_path / "results" / "examples" / path.stem
        left.mkdir(parents=True)
        (left / f"{name}.png").touch()
        (left / f"{name}.html").write_text(head.format(name), encoding="utf-8")
        (left / "index.html").write_text(f"only {name}", encoding="utf-8")  # as an example did
        left.with_suffix(".txt").write_text(f"{left}/{name}.png\n{left}/{name}.html\n")
    monkeypatch.setenv("APPROXJAC_RESULTS", str(tmp_path / "results"))
    monkeypatch.setattr(gallery, "examples", lambda: paths)
    monkeypatch.setattr(gallery, "with_robots", lambda stories, out: stories)
    docs = tmp_path / "docs"
    docs.mkdir()
    gallery.make(SimpleNamespace(srcdir=docs))
    index = docs / "_generated" / "site" / "runs" / "examples" / "index.html"
    text = index.read_text(encoding="utf-8")
    assert all(f'<li><a href="{name}.html"' in text for name in ("wave", "bow"))
