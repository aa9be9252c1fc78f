"""`approxjac paper`: its files, its verdicts, and what it refuses."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pictures import pixels
from PIL import Image

import approxjac as aj
from approxjac.cli import main
from approxjac.paper import experiments

pytestmark = pytest.mark.study  # the numbers of the study are tested in tests/paper


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "approxjac", *arguments], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    """The whole study: its folder and what it printed; `.ci/run` has made it already."""
    if results := os.environ.get("APPROXJAC_RESULTS"):
        printed = Path(results, "paper.txt").read_text(encoding="utf-8")
        return Path(results, "paper"), printed
    out = tmp_path_factory.mktemp("paper")
    process = run("paper", "--out", str(out))
    assert process.returncode == 0
    return out, process.stdout


def test_the_study_makes_every_file(paper):
    out, _ = paper
    figures = ["fig1", *(f"fig{n}" for n in range(3, 9))]
    for name in figures:
        picture = Image.open(out / f"{name}.png")
        assert len(np.unique(np.asarray(picture.convert("L")))) > 50
        assert (out / f"{name}.svg").read_text().rstrip().endswith("</svg>")
    for name in figures[1:]:
        assert aj.Trajectory.load(out / f"{name}.npz").t[-1] == 120.0


def test_the_summary_has_the_agreed_form(paper):
    summary = json.loads((paper[0] / "summary.json").read_text())
    figures = summary["figures"]
    assert sorted(figures) == ["fig1", *(f"fig{n}" for n in range(3, 9))]
    for n in range(3, 9):
        entry = figures[f"fig{n}"]
        assert sorted(entry["error_ratio"], key=float) == ["5", "20", "60", "120"]
        assert entry["verdict"] == ("unstable" if n == 3 else "stable")
        assert entry["agrees_with_paper"] is True
        assert (entry["max_real_eigenvalue"] > 0.0) == (n == 3)
    assert figures["fig5"]["max_real_eigenvalue"] == pytest.approx(-0.0130, abs=5e-5)
    assert figures["fig8"]["theta_hat"] == pytest.approx([3.5, 1.625], rel=0.01)
    true = {"focal_length": 0.05, "distance": 3.0, "roll": 0.0}
    assert summary["truth"] == {"lengths": [1.0, 1.0, 0.5], "object_mass": 0.5, "camera": true}
    assert figures["fig6"]["believed"] == {"lengths": [0.75, 1.25, 0.0], "camera": true}
    assert (figures["fig7"]["kp"], figures["fig7"]["kv"]) == (5000.0, 30000.0)
    assert figures["fig7"]["gravity"] == "known"
    assert figures["fig8"]["gravity"]["L"] == 0.12
    assert figures["fig1"]["condition_23_met_by_figure_4"] is False
    assert figures["fig1"]["allowed_p_at_a_of_figure_4"] < figures["fig1"]["largest_allowed_p"]


def test_the_table_stands_beside_the_papers_words(paper):
    text = paper[1]
    words = "+0.0588 0.5077 1.2592 1.6850 1.5700 unstable “an unstable response”"
    assert words in " ".join(text.split())
    assert "Theorem 1 does not cover it" in text
    assert "learnt θ̂ = (3.5001, 1.6248) kg m" in text
    assert "differs" not in text


@pytest.mark.long
def test_single_figures_and_options(tmp_path, capsys):
    assert main(["paper", "--out", str(tmp_path), "--figures", "4", "--duration", "30"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "fig4.html", "fig4.npz", "fig4.png", "fig4.svg", "index.html", "summary.json",
    ]  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary["figures"]) == ["fig4"]
    assert summary["setup"]["duration"] == 30.0
    assert sorted(summary["figures"]["fig4"]["error_ratio"]) == ["20", "5"]
    assert "Figure 1" not in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.usefixtures("blank_pictures")
def test_a_verdict_whose_evidence_differs_gives_its_reason(tmp_path, capsys):
    main(["paper", "--out", str(tmp_path), "--figures", "3", "--duration", "1"])
    assert "they differ: the run may be too short" in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["figures"]["fig3"]["evidence_agrees"] is False


@pytest.mark.long
def test_an_output_that_knows_no_greek_is_no_crash(tmp_path):
    words = ["paper", "--out", str(tmp_path), "--figures", "6", "--duration", "1"]
    process = subprocess.run(
        [sys.executable, "-m", "approxjac", *words],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert process.returncode == 0
    assert process.stderr == ""  # the progress bar is for terminals only
    assert "max Re ?" in process.stdout


def test_a_file_in_the_way_gives_exit_code_2(tmp_path, capsys):
    (tmp_path / "fig1.png").mkdir()
    assert main(["paper", "--out", str(tmp_path), "--figures", "1"]) == 2
    assert "fig1.png" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("blank_pictures")
def test_a_verdict_that_differs_gives_exit_code_1(tmp_path, capsys, monkeypatch):
    # the gains of Figure 4 settle the response that the paper calls unstable
    settling = dataclasses.replace(experiments.EXPERIMENTS[3], kv=10000.0)
    monkeypatch.setitem(experiments.EXPERIMENTS, 3, settling)
    code = main(["paper", "--out", str(tmp_path), "--figures", "3", "--duration", "30"])
    assert code == 1
    out = capsys.readouterr().out
    assert out.startswith("verdicts: 0 of 1 as in the paper")
    assert "(differs)" in out
    assert "max Re λ = -" in out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--figures"], "approxjac: --figures must be numbers, got nothing"),
        (["--figures", "2"], "approxjac: --figures must be among 1, 3, 4, 5, 6, 7, 8, got 2"),
        (["--duration", "0"], "approxjac: --duration must be a finite number > 0"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(tmp_path, capsys, arguments, text):
    assert main(["paper", "--out", str(tmp_path), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(text)
    assert captured.err.count("\n") == 1


def test_a_folder_that_cannot_be_made(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["paper", "--out", str(tmp_path / "file" / "out"), "--figures", "1"]) == 2
    assert "--out must be a folder that can be made, got" in capsys.readouterr().err


def test_the_study_writes_pages_with_an_index(paper):
    out, printed = paper
    assert f"{Path(out.name, 'index.html')}\n" in printed.partition("See them move: ")[2]
    index = (out / "index.html").read_text(encoding="utf-8")
    for n in range(3, 9):
        assert f'href="fig{n}.html"' in index
        assert f'src="fig{n}.png"' in index
        assert (out / f"fig{n}.html").stat().st_size < 4_000_000
    assert index.index("fig1.png") < index.index("fig3.html") < index.index("fig8.html")
    assert "wrong by 60°, a = 1 — unstable; the paper: “an unstable response”" in index


@pytest.mark.parametrize(
    "n",  # all wrong with learnt gravity; of the others are parts
    [pytest.param(n, marks=() if n == 8 else pytest.mark.long) for n in range(3, 9)],
)
def test_the_pages_of_the_study_load(paper, open_page, n):
    """And show how each run ends: its error, and the believed tip elsewhere if the arm is wrong."""
    out, _ = paper
    index = open_page(out / "index.html", (640, 480))
    links = index.eval_on_selector_all("li a", "links => links.map((a) => a.href)")
    assert [link.rsplit("/", 1)[1] for link in links] == [f"fig{n}.html" for n in range(3, 9)]
    index.goto(links[n - 3])
    index.evaluate("approxjac.pause(); approxjac.seek(1e9)")
    index.wait_for_timeout(150)
    assert len(np.unique(pixels(index).reshape(-1, 3), axis=0)) > 300
    run = aj.Trajectory.load(out / f"fig{n}.npz")
    tip, believed, error = (
        np.array(index.evaluate(f"approxjac.column('{name}').at(-1)"))
        for name in ("tip", "believed_tip", "error")
    )
    np.testing.assert_allclose(error, 1e3 * run.error[-1], rtol=1e-5, atol=1e-9)
    assert (np.linalg.norm(error) < 5.0) == (n != 3)
    wrong_arm = n >= 6
    assert (np.linalg.norm(tip - believed) > 0.05) == wrong_arm


@pytest.mark.long
@pytest.mark.usefixtures("blank_pictures")
def test_without_meshcat_the_study_says_that_there_are_no_pages(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshcat.geometry", None)
    main(["paper", "--figures", "6", "--duration", "1", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert "There are no pages to see in a browser: " in told
    assert "needs meshcat" in told
    assert "pip install 'approxjac[view]'" in told
    assert not list(tmp_path.glob("*.html"))
