"""Every example runs as a user runs it, and makes the pictures it says it makes."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9][0-9]_*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_runs_and_makes_its_pictures(path, tmp_path):
    """And pages, of which an index has the links."""
    process = subprocess.run(
        [sys.executable, str(path), "--out", str(tmp_path)], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    made = set(tmp_path.iterdir())
    for path in made:
        assert str(path) in process.stdout
        assert path.stat().st_size > (1000 if path.name == "index.html" else 10_000)
    assert {".png", ".svg"} <= {path.suffix for path in made} <= {".png", ".svg", ".html"}
    pages = [path for path in made if path.suffix == ".html" and path.name != "index.html"]
    for page in pages:
        assert page.stat().st_size < 4_000_000
        assert f'href="{page.name}"' in (tmp_path / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_an_example_is_short_and_says_what_one_will_see(path):
    text = path.read_text(encoding="utf-8")
    assert 30 <= len(text.splitlines()) <= 120
    header = ast.get_docstring(ast.parse(text))
    assert "You will see:" in header
    assert f"python examples/{path.name}" in header


def test_there_are_examples():
    assert [path.stem[:2] for path in EXAMPLES] == [f"{n:02}" for n in range(1, len(EXAMPLES) + 1)]
    assert len(EXAMPLES) >= 3
