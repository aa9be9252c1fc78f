"""Every example runs as a user runs it, and makes the pictures and pages it says it makes."""

import ast
import functools
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from pictures import pixels
from programs import run_python

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9][0-9]_*.py"))
PAGES = {
    "01": ["01_panda_unknown_tool"],
    "02": ["02_uncalibrated_camera"],
    "03": ["03_learnt_gravity"],
    "04": ["04_seven_joints_panda", "04_seven_joints_talos_arm", "04_seven_joints_xarm7"],
    "05": ["05_panda_pose"],
    "06": ["06_singular_pose"],
    "07": ["07_tolerated_tools"],
    "08": ["08_half_the_torque"],
    "09": ["09_camera_in_the_room"],
    "10": ["10_eye_in_the_hand"],
    "11": ["11_on_a_robot"],
    "12": ["12_what_breaks_it"],
    "13": ["13_circle_unknown_tool"],
    "14": ["14_tracker_turned"],
    "15": ["15_calibrate_on_the_job"],
    "17": ["17_wall"],
    "18": ["18_own_law"],
    "19": ["19_own_task"],
    "20": ["20_own_saturation"],
    "21": ["21_own_gravity"],
    "22": ["22_own_limit"],
}
REACHES = ("01", "04", "09")  # whose pages end at a target, with a belief that is wrong
# whose meshes are drawn for seconds, and which show no more than the others
ELSEWHERE = ("04_seven_joints_panda", "04_seven_joints_talos_arm", "04_seven_joints_xarm7")


@functools.cache
def ran(path):
    """Run an example; return its path, its folder, its exit code and what it said of errors."""
    results = os.environ.get("APPROXJAC_RESULTS")  # for docs/_ext/gallery.py
    out = Path(results or tempfile.mkdtemp(), "examples", path.stem)
    out.mkdir(parents=True)
    code, printed, errors = run_python(path, "--out", out)
    out.with_suffix(".txt").write_text(printed, encoding="utf-8")
    return path, out, code, errors


@pytest.fixture(params=EXAMPLES, ids=lambda path: path.stem)
def example(request):
    """An example that was run."""
    return ran(request.param)


def pages_of(example):
    return [example[1] / f"{name}.html" for name in PAGES.get(example[0].stem[:2], [])]


@pytest.mark.study
def test_an_example_runs_and_makes_its_files(example):
    _, out, code, errors = example
    printed = out.with_suffix(".txt").read_text(encoding="utf-8")
    assert errors == ""
    assert code == 0
    # a folder is of C, which tests of its own compile
    made, pages = {path for path in out.iterdir() if path.is_file()}, set(pages_of(example))
    for path in made:
        assert str(path) in printed
        assert path.stat().st_size > (1000 if path.name == "index.html" else 10_000)
    index = out / "index.html"
    assert {path for path in made if path.suffix not in (".png", ".svg", ".urdf")} - {
        index
    } == pages
    assert {".png", ".svg"} <= {path.suffix for path in made}
    for page in pages:
        assert page.stat().st_size < 4_000_000
        listed = index.read_text(encoding="utf-8")
        assert f'href="{page.name}"' in listed
        assert f"<b>{page.stem}" not in listed


@pytest.mark.parametrize(
    ("path", "name"),
    [  # of several arms' pages one whose arm no other page has
        pytest.param(
            path,
            name,
            id=f"{path.stem}-{name}",
            marks=pytest.mark.long if name in ELSEWHERE else (),
        )
        for path in EXAMPLES
        if path.stem[:2] in REACHES
        for name in PAGES[path.stem[:2]]
    ],
)
def test_its_pages_show_that_the_true_tip_arrives(path, name, open_page):
    page = open_page(ran(path)[1] / f"{name}.html", (640, 480))
    page.evaluate("approxjac.pause(); approxjac.seek(1e9)")
    page.wait_for_timeout(200)
    assert len(np.unique(pixels(page).reshape(-1, 3), axis=0)) > 500
    end = {
        name: np.array(page.evaluate(f"approxjac.column('{name}').at(-1)"), dtype=float)
        for name in ("tip", "target", "believed_tip", "error")
    }
    assert np.linalg.norm(end["tip"] - end["believed_tip"]) > 0.1
    if np.isfinite(end["target"]).all():
        assert np.linalg.norm(end["tip"] - end["target"]) < 2e-3
    else:  # a target in an image, and an error in pixels
        assert np.abs(end["error"]).max() < 2.0


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_is_short_and_says_what_one_will_see(path):
    text = path.read_text(encoding="utf-8")
    assert 30 <= len(text.splitlines()) <= 120
    header = ast.get_docstring(ast.parse(text))
    assert "You will see:" in header
    assert "You will learn:" in header
    assert f"python examples/{path.name}" in header


def test_the_readme_shows_the_first_example():
    """Its first code is that of the example, statement by statement, and its picture the same."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    code = readme.partition("```python\n")[2].partition("```")[0]
    example = ast.parse(EXAMPLES[0].read_text(encoding="utf-8"))
    statements = [ast.dump(statement) for statement in example.body]
    shown = [ast.dump(statement) for statement in ast.parse(code).body]
    assert len(shown) > 8
    assert shown == [statement for statement in statements if statement in shown]
    assert f"examples/{EXAMPLES[0].name}" in readme


def test_there_are_examples():
    assert [path.stem[:2] for path in EXAMPLES] == [f"{n:02}" for n in range(1, len(EXAMPLES) + 1)]
    assert len(EXAMPLES) >= 3
