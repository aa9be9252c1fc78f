"""Runs the study and the examples when the site is built, so that its figures are never old."""

import contextlib
import io
import subprocess
import sys
from pathlib import Path

from approxjac.cli import main

ROOT = Path(__file__).parents[2]


def make(app):
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = main(["paper", "--out", str(folder / "paper")])
    if code != 0:
        raise RuntimeError(f"approxjac paper ended with exit code {code}")
    text = printed.getvalue().split("\nPictures")[0]
    (folder / "paper_table.txt").write_text(text, encoding="utf-8")
    for example in sorted((ROOT / "examples").glob("*.py")):
        subprocess.run(
            [sys.executable, str(example), "--out", str(folder / "examples")],
            check=True,
            stdout=subprocess.DEVNULL,
        )


def setup(app):
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
