import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios

import numpy as np
import pytest
from PIL import Image

import approxjac as aj
from approxjac.cli import main


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "approxjac", *arguments], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def paper(tmp_path_factory):
    """The whole study, run once as a user runs it."""
    out = tmp_path_factory.mktemp("paper")
    return out, run("paper", "--out", str(out))


def test_the_study_makes_every_file(paper):
    out, process = paper
    assert process.returncode == 0
    assert process.stderr == ""  # the progress bar is for terminals only
    figures = ["fig1", *(f"fig{n}" for n in range(3, 9))]
    for name in figures:
        picture = Image.open(out / f"{name}.png")
        assert len(np.unique(np.asarray(picture.convert("L")))) > 50
        assert (out / f"{name}.svg").read_text().rstrip().endswith("</svg>")
    for name in figures[1:]:
        assert aj.Trajectory.load(out / f"{name}.npz").t[-1] == 120.0


def test_the_summary_has_the_agreed_form(paper):
    figures = json.loads((paper[0] / "summary.json").read_text())["figures"]
    assert sorted(figures) == ["fig1", *(f"fig{n}" for n in range(3, 9))]
    for n in range(3, 9):
        entry = figures[f"fig{n}"]
        assert sorted(entry["error_ratio"], key=float) == ["5", "20", "60", "120"]
        assert entry["verdict"] == ("unstable" if n == 3 else "stable")
        assert entry["agrees_with_paper"] is True
        assert (entry["max_real_eigenvalue"] is None) == (n == 8)
    assert figures["fig5"]["max_real_eigenvalue"] == pytest.approx(-0.0130, abs=5e-5)
    assert figures["fig8"]["theta_hat"] == pytest.approx([3.5, 1.625], rel=0.01)
    assert figures["fig1"]["condition_23_met_by_figure_4"] is False
    assert figures["fig1"]["allowed_p_at_a_of_figure_4"] < figures["fig1"]["largest_allowed_p"]


def test_the_table_stands_beside_the_papers_words(paper):
    text = paper[1].stdout
    assert "+0.0588   0.5077  1.2592  1.6850  1.5700  unstable  “an unstable response”" in text
    assert "Theorem 1 does not cover it" in text
    assert "learnt θ̂ = (3.5001, 1.6248) kg m" in text
    assert "differs" not in text


def test_single_figures_and_options(tmp_path, capsys):
    code = main(
        ["paper", "--out", str(tmp_path), "--figures", "4", "--duration", "30", "--friction", "0.5"]
    )
    assert code == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "fig4.npz", "fig4.png", "fig4.svg", "summary.json",
    ]  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary["figures"]) == ["fig4"]
    assert summary["setup"]["friction"] == 0.5
    assert sorted(summary["figures"]["fig4"]["error_ratio"]) == ["20", "5"]
    assert "Figure 1" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (["--gamma", "0.005"], {"gamma": 0.005}),
        (["--inertia", "point-mass"], {"inertia": "point-mass"}),
        (["--friction", "0.5"], {"friction": 0.5}),
    ],
)
def test_each_option_reaches_the_run(tmp_path, option, expected):
    usual, changed = tmp_path / "usual", tmp_path / "changed"
    short = ["--figures", "4", "--duration", "2"]
    main(["paper", "--out", str(usual), *short])
    main(["paper", "--out", str(changed), *short, *option])
    setup = json.loads((changed / "summary.json").read_text())["setup"]
    assert expected.items() <= setup.items()
    runs = [aj.Trajectory.load(folder / "fig4.npz") for folder in (usual, changed)]
    assert np.abs(runs[0].q - runs[1].q).max() > 1e-3


def test_a_singular_target_is_no_crash(tmp_path, capsys):
    arguments = ["--figures", "1", "4", "--target", "0", "0", "--duration", "5"]
    assert main(["paper", "--out", str(tmp_path), *arguments]) == 1
    assert "singular posture" in capsys.readouterr().out


def test_a_verdict_whose_evidence_differs_gives_its_reason(tmp_path, capsys):
    main(["paper", "--out", str(tmp_path), "--figures", "3", "--duration", "1"])
    assert "they differ: the run may be too short" in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["figures"]["fig3"]["evidence_agrees"] is False


def test_an_output_that_knows_no_greek_is_no_crash(tmp_path):
    process = subprocess.run(
        [sys.executable, "-m", "approxjac", "paper", "--out", str(tmp_path), "--figures", "4"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert process.returncode == 0
    assert "max Re ?" in process.stdout


def test_a_file_in_the_way_gives_exit_code_2(tmp_path, capsys):
    (tmp_path / "fig1.png").mkdir()
    assert main(["paper", "--out", str(tmp_path), "--figures", "1"]) == 2
    assert "fig1.png" in capsys.readouterr().err


def test_degrees_become_radians(tmp_path):
    arguments = ["--start", "30", "60", "--target", "80", "70", "--duration", "1"]
    main(["paper", "--out", str(tmp_path), "--figures", "4", *arguments])
    setup = json.loads((tmp_path / "summary.json").read_text())["setup"]
    assert setup["start"] == pytest.approx(np.radians([30, 60]))
    assert setup["target"] == pytest.approx(np.radians([80, 70]))


def test_a_verdict_that_differs_gives_exit_code_1(tmp_path, capsys):
    # enough friction settles the response that the paper calls unstable
    code = main(["paper", "--out", str(tmp_path), "--figures", "3", "--friction", "50"])
    assert code == 1
    out = capsys.readouterr().out
    assert "<< differs" in out
    assert "max Re λ = -" in out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--figures"], "approxjac: figures must name at least one figure, got none"),
        (["--figures", "2"], "approxjac: figures must be among 1, 3, 4, 5, 6, 7, 8, got 2"),
        (["--friction", "-1"], "approxjac: friction must be a finite number >= 0"),
        (["--start", "90", "90"], "approxjac: start must not have the image of the target already"),
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


def test_arguments_that_do_not_parse_give_exit_code_2():
    process = run("paper", "--inertia", "ring")
    assert process.returncode == 2
    assert "ring" in process.stderr + process.stdout


def test_help_and_version(capsys):
    assert run("paper", "--help").returncode == 0
    assert "--duration" in run("paper", "--help").stdout
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"approxjac {aj.__version__}\n"


def test_a_terminal_gets_a_progress_bar(tmp_path):
    controller, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "approxjac", "paper", "--out", str(tmp_path), "--figures", "4"],
        stdout=subprocess.DEVNULL,
        stderr=terminal,
    )
    os.close(terminal)
    shown = b""
    while True:
        try:
            chunk = os.read(controller, 4096)
        except OSError:
            break
        if not chunk:
            break
        shown += chunk
    assert process.wait(timeout=60) == 0
    assert b"figure 4" in shown
    assert b"100%" in shown
