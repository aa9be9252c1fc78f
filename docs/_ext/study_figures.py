"""Runs the study when the site is built, so that its figures are never old.

They go into pages of the site; the pages of its runs become part of it as they are. With
APPROXJAC_RESULTS in the environment, what the study left in that folder is shown instead.
"""

import contextlib
import io
import json
import os
import shutil
from pathlib import Path

from approxjac.cli import main

ROOT = Path(__file__).parents[2]


def table(figures):
    """The verdicts of summary.json as Markdown."""
    times = ("5", "20", "60", "120")
    lines = [
        f"| figure | max Re λ [1/s] | {' | '.join(f'{t} s' for t in times)} | verdict | paper |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, entry in figures.items():
        if "verdict" not in entry:
            continue
        cells = [
            f"{name.removeprefix('fig')}: {entry['title']}",
            f"{entry['max_real_eigenvalue']:+.4f}",
            *(f"{entry['error_ratio'][t]:.4f}" for t in times),
            entry["verdict"],
            entry["paper"],
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def make(app):
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    if results := os.environ.get("APPROXJAC_RESULTS"):
        shutil.copytree(Path(results, "paper"), folder / "paper", dirs_exist_ok=True)
    else:
        with contextlib.redirect_stdout(io.StringIO()):
            code = main(["paper", "--out", str(folder / "paper")])
        if code != 0:
            raise RuntimeError(f"approxjac paper ended with exit code {code}")
    summary = json.loads((folder / "paper" / "summary.json").read_text(encoding="utf-8"))
    (folder / "paper_table.md").write_text(table(summary["figures"]), encoding="utf-8")
    gather(folder / "paper", folder / "site" / "runs" / "paper")


def gather(folder, site):
    """Copy the pages of runs, with the pictures that their index may show."""
    shutil.rmtree(site, ignore_errors=True)
    site.mkdir(parents=True)
    for path in [*folder.glob("*.html"), *folder.glob("*.png")]:
        shutil.copy(path, site)


def setup(app):
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
