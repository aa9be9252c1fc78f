import asyncio
import fcntl
import json
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pictures import pixels
from PIL import Image
from tornado.websocket import websocket_connect

import approxjac as aj
from approxjac.cli import main
from approxjac.robots.catalog import NAMED, urdf_path


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
        "fig4.html", "fig4.npz", "fig4.png", "fig4.svg", "index.html", "summary.json",
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


def test_robots_lists_every_arm(capsys):
    assert main(["robots"]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[0].split() == [
        "name", "nv", "nq", "joints", "effort", "limits", "suggested", "tip", "kg",
    ]  # fmt: skip
    assert [line.split()[0] for line in lines[2:-2]] == list(aj.robot_names())
    words = {line.split()[0]: " ".join(line.split()) for line in lines[2:-2]}
    assert words["panda"] == "panda 7 7 7 revolute 12-87 panda_hand_tcp 16.8"
    assert words["kinova"].startswith("kinova 6 9 3 continuous, 3 revolute 20-80 j2s6s200_end_")
    assert words["tiago_arm"].startswith("tiago_arm 8 8 1 prismatic, 7 revolute 2000, 3-39 wrist_")
    assert words["double_pendulum"] == "double_pendulum 2 2 2 revolute none known link3 0.5"
    assert lines[-1] == "Effort limits are in N m, those of prismatic joints in N."


def test_robots_describes_one(capsys):
    assert main(["robots", "tiago_arm"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("tiago_arm: 1 prismatic, 7 revolute; nv 8, nq 8; 18.21 kg\n")
    words = [" ".join(line.split()) for line in out.splitlines()]
    assert "tip: wrist_ft_tool_link" in words
    assert "torso_lift_joint prismatic 0 to 0.35 m 2000 N" in words
    assert "arm_1_joint revolute 0 to 2.749 rad 39 N m" in words
    assert "locked: wheel_right_joint, wheel_left_joint, head_1_joint, head_2_joint" in words
    main(["robots", "panda", "--free", "panda_finger_joint1"])
    out = capsys.readouterr().out
    assert "panda_finger_joint1  prismatic  0 to 0.04 m            100 N" in out
    assert "moving with another joint: panda_finger_joint2" in out
    assert "locked" not in out
    main(["robots", "panda", "--free", "all"])
    assert "nv 8, nq 8" in capsys.readouterr().out
    main(["robots", "kinova"])
    assert "j2s6s200_joint_1  continuous  none                 40 N m" in capsys.readouterr().out
    main(["robots", "double_pendulum"])
    assert "joint1  revolute  none known  none known" in capsys.readouterr().out
    main(["robots", "talos_arm"])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_robots_takes_any_urdf(capsys):
    path = str(urdf_path(NAMED["baxter_left_arm"]))
    assert main(["robots", path]) == 0
    out = capsys.readouterr().out
    assert "nv 17, nq 17" in out
    assert "tip: not clear, as it has more than one end: name one as tip" in out
    assert main(["robots", path, "--tip", "right_gripper"]) == 0
    by_path = capsys.readouterr().out.splitlines()
    assert main(["robots", "baxter_left_arm", "--tip", "right_gripper"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == by_path[1:]
    assert main(["robots", "talos_arm", "--base", "base_link"]) == 0
    assert "9 revolute" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["pnada"], "approxjac: robot 'pnada' not in the robots known by name; did you mean 'pan"),
        (["nowhere.urdf"], "approxjac: URDF file nowhere.urdf does not exist"),
        (["panda", "--free", "thumb"], "approxjac: moving joint 'thumb' not in panda; valid are "),
        (["panda", "--tip", "hand"], "approxjac: frame 'hand' not in panda; did you mean"),
        (["--tip", "hand"], "approxjac: --tip, --base and --free need a robot, got none"),
    ],
)
def test_a_robot_that_does_not_load_gives_exit_code_2(capsys, arguments, text):
    assert main(["robots", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(text)
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_help_and_version(capsys):
    assert run("paper", "--help").returncode == 0
    assert "--duration" in run("paper", "--help").stdout
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"approxjac {aj.__version__}\n"


def test_the_list_of_commands_has_a_line_each_and_their_own_help_has_all():
    listed, own = run("--help").stdout, run("stability", "--help").stdout
    assert "Tell whether a controller is stable before anything moves" in listed
    assert "Exit code" not in listed
    assert "Example: approxjac stability panda --object-length 0 0.3" in own
    assert "Exit code 0 if Theorem 1 or the matrix form certifies the region, 1 if not." in own


@pytest.mark.parametrize("command", ["simulate", "stability", "servo"])
def test_every_length_and_time_in_the_help_has_its_unit(command):
    text = run(command, "--help").stdout.split("positional arguments")[1]  # after the example
    text = " ".join(text.replace("│", " ").split())
    lengths = [name for name in ("--object-length", "--believed-length") if name in text]
    for name in lengths:
        assert " m. (default" in text.split(name, 1)[1].split(" --", 1)[0], name
    assert " s. (default" in text.split("--settling-time", 1)[1].split(" --", 1)[0]


def test_a_command_that_does_not_exist_is_one_line_with_what_was_meant(capsys):
    assert main(["simulat", "panda"]) == 2
    assert capsys.readouterr().err == (
        "approxjac: command 'simulat' not in approxjac; did you mean 'simulate'?\n"
    )


def test_the_shell_completes_commands_and_options(tmp_path):
    script = tmp_path / "approxjac.bash"
    assert run("--tyro-write-completion", "bash", str(script)).returncode == 0
    subprocess.run(["bash", "-n", str(script)], check=True)
    ask = (
        f"source {script}; COMP_WORDS=(approxjac simulate --object-l); COMP_CWORD=2; "
        '_tyro_approxjac; echo "${COMPREPLY[@]}"; '
        'COMP_WORDS=(approxjac stab); COMP_CWORD=1; _tyro_approxjac; echo "${COMPREPLY[@]}"'
    )
    answer = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == ["--object-length", "stability"]
    assert run("--tyro-print-completion", "zsh").stdout.startswith("#compdef approxjac")


def test_the_command_line_imports_nothing_slow():
    code = "import sys, approxjac.cli; print(*sys.modules)"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = {name.split(".")[0] for name in process.stdout.split()}
    slow = {"matplotlib", "scipy", "meshcat", "trimesh", "mujoco", "osqp", "qpsolvers"}
    assert not slow & loaded


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


def test_a_reader_that_has_seen_enough_is_no_error():
    words = [sys.executable, "-m", "approxjac", "robots"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() in (0, 128 + 13)  # all was written, or nobody read it


# -- approxjac simulate and approxjac arms ----------------------------------------------

HOME = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
TOML = f"""
robot = "panda"
object_length = 0.3
joint_shifts = {{ panda_joint4 = [0.0, 0.01, 0.0] }}
start = {HOME}
target_offset = [0.05, -0.05, 0.05]
gravity = "exact"
duration = 6.0
rate = 500.0
"""


def test_simulate_prints_and_writes_what_became_of_it(tmp_path):
    start = [str(number) for number in HOME]
    process = run(
        "simulate", "panda", "--object-length", "0.2", "--object-mass", "0.5",
        "--believed-length", "0", "--joint-shifts", "panda_joint4", "0", "0.01", "0",
        "--start", *start, "--target-offset", "0.05", "-0.05", "0.05", "--duration", "8",
        "--rate", "500", "--out", str(tmp_path),
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert "verdict     converged" in process.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["verdict"] == "converged"
    assert summary["final_error_m"] < 1e-3
    assert summary["settings"]["joint_shifts"] == {"panda_joint4": [0.0, 0.01, 0.0]}
    for name in ("final_error_m", "settling_time_s", "peak_torque_ratio"):
        assert isinstance(summary[name], float)
    picture = Image.open(tmp_path / "run.png")
    assert len(np.unique(np.asarray(picture.convert("L")))) > 50
    assert aj.Trajectory.load(tmp_path / "run.npz").t[-1] == pytest.approx(8.0)


def test_a_file_says_the_same_as_options_and_options_come_before_it(tmp_path, capsys):
    path = tmp_path / "reach.toml"
    path.write_text(TOML, encoding="utf-8")
    assert main(["simulate", str(path), "--out", str(tmp_path / "a")]) == 0
    options = [
        "simulate", "panda", "--object-length", "0.3", "--joint-shifts", "panda_joint4", "0",
        "0.01", "0", "--start", *map(str, HOME), "--target-offset", "0.05", "-0.05", "0.05",
        "--gravity", "exact", "--duration", "6", "--rate", "500", "--out", str(tmp_path / "b"),
    ]  # fmt: skip
    assert main(options) == 0
    a, b = (json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab")
    assert a == b
    assert main(["simulate", str(path), "--duration", "0.5", "--out", str(tmp_path / "c")]) == 1
    short = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert short["settings"]["duration"] == 0.5
    assert short["settings"]["object_length"] == 0.3
    assert short["verdict"] == "not converged"
    capsys.readouterr()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot = 1", "must name a robot, such as robot = \"panda\", got 1"),
        ("object_length = 0.1", "must name a robot"),
        ('robot = "panda"\nobject_lenght = 0.1', "did you mean 'object_length'"),
        ("robot = ", "cannot be read as TOML"),
    ],
)  # fmt: skip
def test_a_bad_file_is_one_clear_line(tmp_path, capsys, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["simulate", str(path), "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_bad_options_of_simulate_are_one_clear_line(tmp_path, capsys):
    for words, message in (
        (["pando"], "robot 'pando' not in the robots known by name; did you mean"),
        (["panda", "--object-length", "-1"], "length must be a finite number >= 0"),
        (["panda", "--floor", "0"], "a floor needs the engine mujoco"),
        (["missing.toml"], "missing.toml does not exist"),
    ):
        assert main(["simulate", *words, "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_arms_writes_a_table(tmp_path, capsys):
    words = ["arms", "--robots", "ur5", "--starts", "1", "--duration", "8", "--jobs", "2"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| ur5 | 20 cm, 0.5 kg | 1 of 1 |" in table
    assert table in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["verdict"] == "ok"
    assert len(summary["runs"]) == 2


def test_a_file_may_name_the_folder_and_values_that_begin_with_a_minus(tmp_path, capsys):
    path, out = tmp_path / "reach.toml", tmp_path / "there"
    path.write_text(f'{TOML}object_axis = "-x"\nout = "{out}"\n', encoding="utf-8")
    words = ["--duration=1", "--target", "0.4", "0.1", "0.5"]  # in place of the file's offset
    assert main(["simulate", *words, str(path)]) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["object_axis"] == "-x"
    assert summary["target"] == [0.4, 0.1, 0.5]
    capsys.readouterr()


def test_simulate_with_torque_limits_says_what_they_did(tmp_path, capsys):
    path = tmp_path / "reach.toml"
    limits = 'torque_limits = 0.5\nlimiter = "clip"\n'
    path.write_text(f"{TOML}{limits}settling_time = 0.5\n", encoding="utf-8")
    words = ["--duration", "0.2", "--limiter", "qp", "--out", str(tmp_path / "run")]
    assert main(["simulate", str(path), *words]) == 1
    assert "\nlimiter     qp, 0.5 of the effort limits: " in capsys.readouterr().out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["limits"]["steps"] == 101
    assert summary["settings"]["limiter"] == "qp"
    for words, message in (
        (["--limiter", "qp"], "limiter needs torque_limits"),
        (["--torque-limits", "all"], 'torque_limits must be "urdf" or a positive share'),
    ):
        assert main(["simulate", "panda", *words, "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_limiters_writes_a_table_a_picture_and_a_summary(tmp_path, capsys):
    words = ["--robots", "two_link", "--scales", "0.5", "--starts", "1", "--duration", "1"]
    assert main(["limiters", *words, "--jobs", "1", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| two_link | × 0.5 | 1 |" in table
    out = capsys.readouterr().out
    assert table in out
    assert "all kept" in out
    assert {path.name for path in tmp_path.iterdir()} == {
        "limiters.png", "limiters.svg", "summary.json", "table.md",
    }  # fmt: skip
    assert json.loads((tmp_path / "summary.json").read_text())["verdict"] == "ok"


def test_limiters_that_fall_short_give_exit_code_1(tmp_path, capsys, monkeypatch):
    from approxjac.studies import limiters_report

    monkeypatch.setattr(limiters_report, "shortcomings", lambda outcomes: ["it broke a limit"])
    words = ["--robots", "two_link", "--scales", "1", "--starts", "1", "--duration", "0.1"]
    assert main(["limiters", *words, "--jobs", "1", "--out", str(tmp_path)]) == 1
    assert "fell short: it broke a limit" in capsys.readouterr().out


# -- approxjac servo --------------------------------------------------------------------

SERVO = """
robot = "two_link"
roll = 0.3
focal_factor = 1.3
camera_shift = [-0.02, 0.0, 0.01]
duration = 3.0
rate = 400.0
"""


def test_servo_prints_and_writes_what_became_of_it(tmp_path):
    process = run(
        "servo", "two_link", "--roll", "0.3", "--depth-factor", "1.2", "--noise", "0.3",
        "--duration", "3", "--rate", "400", "--out", str(tmp_path),
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert "verdict     converged" in process.stdout
    assert "believed    camera rolled by 17.2°, depth × 1.2" in process.stdout
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.png", "run.svg", "image.png", "image.svg", "views.png", "views.svg", "run.npz",
        "summary.json",
    }  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["verdict"] == "converged"
    assert summary["final_error_px"] < 0.3 == summary["tolerance_px"]
    assert summary["settings"]["depth_factor"] == 1.2
    assert aj.Trajectory.load(tmp_path / "run.npz").t[-1] == pytest.approx(3.0)


def test_servo_takes_a_file_and_options_come_before_it(tmp_path, capsys):
    path = tmp_path / "servo.toml"
    path.write_text(SERVO, encoding="utf-8")
    assert main(["servo", str(path), "--out", str(tmp_path / "a")]) == 0
    options = [
        "servo", "two_link", "--roll", "0.3", "--focal-factor", "1.3", "--camera-shift", "-0.02",
        "0", "0.01", "--duration", "3", "--rate", "400", "--out", str(tmp_path / "b"),
    ]  # fmt: skip
    assert main(options) == 0
    a, b = (json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab")
    assert a == b
    words = ["--duration", "0.2", "--lost", "0.05", "0.1", "--out", str(tmp_path / "c")]
    assert main(["servo", str(path), *words]) == 1
    short = json.loads((tmp_path / "c" / "summary.json").read_text())
    assert short["settings"]["lost"] == [0.05, 0.1]
    assert short["settings"]["roll"] == 0.3
    assert short["verdict"] == "not converged"
    assert "verdict     not converged: " in capsys.readouterr().out


def test_bad_options_of_servo_are_one_clear_line(tmp_path, capsys):
    path = tmp_path / "bad.toml"
    path.write_text('robot = "panda"\nrol = 0.3\n', encoding="utf-8")
    for words, message in (
        (["pando"], "robot 'pando' not in the robots known by name; did you mean"),
        (["panda", "--points", "4"], "points must be at most half as many as joints"),
        (["panda", "--focal-length", "0"], "focal_length must be > 0"),
        (["panda", "--target", "700", "100"], "target must be within the image of 640 x 480 px"),
        (["panda", "--law", "ibvs", "--gravity", "learnt"], "gravity must be exact, believed or"),
        (["panda", "--lost-point", "1"], "lost_point must be one of the points"),
        (["panda", "--eye", "in-hand", "--camera-target", "1", "0", "0"], "for an eye to hand"),
        (["missing.toml"], "missing.toml does not exist"),
        ([str(path)], "did you mean 'roll'"),
    ):
        assert main(["servo", *words, "--out", str(tmp_path)]) == 2
        captured = capsys.readouterr()
        assert message in captured.err
        assert captured.err.count("\n") == 1
        assert captured.out == ""


# -- in a browser ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reached(tmp_path_factory):
    """A short run, as `simulate` leaves it."""
    out = tmp_path_factory.mktemp("reached")
    process = run("simulate", "panda", "--duration", "0.5", "--out", str(out))
    assert process.returncode in (0, 1), process.stderr
    assert f"See it move: approxjac view {out / 'run.npz'}" in process.stdout
    return out


def test_a_run_becomes_a_page(reached, tmp_path, capsys):
    for given in (reached, reached / "run.npz"):
        page = tmp_path / f"{given.name}.html"
        assert main(["view", str(given), "--out", str(page), "--title", "Seen <here>"]) == 0
        assert capsys.readouterr().out == f"{page}\n"
        assert "<title>Seen &lt;here&gt;</title>" in page.read_text(encoding="utf-8")
        assert page.stat().st_size < 4_000_000


def test_a_page_beside_its_run_is_opened(reached, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr(
        "approxjac.view.browser.opening.open_browser", lambda url: opened.append(url) or True
    )
    assert main(["view", str(reached)]) == 0
    page = reached / "run.html"
    assert opened == [page.resolve().as_uri()]
    assert capsys.readouterr().out == f"{page}\n"
    monkeypatch.setattr("approxjac.view.browser.opening.open_browser", lambda url: False)
    assert main(["view", str(reached)]) == 0
    assert "No browser could be opened here: open it in yours" in capsys.readouterr().out


def test_what_is_no_run_is_a_clear_error(reached, tmp_path, capsys):
    (tmp_path / "two").mkdir()
    for name in ("a.npz", "b.npz"):
        (tmp_path / "two" / name).touch()
    (tmp_path / "old.npz").write_bytes(b"no run")
    for given, message in (
        (tmp_path / "two", "RUN must be a file, or a folder with one run (.npz)"),
        (tmp_path / "two", "with a.npz, b.npz"),
        (tmp_path, "is not a trajectory written by"),
        (tmp_path / "gone.npz", "does not exist"),
    ):
        assert main(["view", str(given)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("approxjac: ")
        assert message in error
        assert error.count("\n") == 1
    assert main(["view", str(reached), "--out", str(tmp_path / "no" / "page.html")]) == 2
    assert "path must be a file that can be written" in capsys.readouterr().err


def test_the_study_writes_pages_with_an_index(paper):
    out, process = paper
    assert f"See them move: {out / 'index.html'}" in process.stdout
    index = (out / "index.html").read_text(encoding="utf-8")
    for n in range(3, 9):
        assert f'href="fig{n}.html"' in index
        assert f'src="fig{n}.png"' in index
        assert (out / f"fig{n}.html").stat().st_size < 4_000_000
    assert index.index("fig1.png") < index.index("fig3.html") < index.index("fig8.html")
    assert "wrong by 60°, a = 1 — unstable; the paper: “an unstable response”" in index


@pytest.mark.study
def test_the_pages_of_the_study_load(paper, open_page):
    """And show how each run ends: its error, and the believed tip elsewhere if the arm is wrong."""
    out, _ = paper
    index = open_page(out / "index.html", (640, 480))
    links = index.eval_on_selector_all("a", "links => links.map((a) => a.href)")
    assert [link.rsplit("/", 1)[1] for link in links] == [f"fig{n}.html" for n in range(3, 9)]
    for n, link in enumerate(links, start=3):
        index.goto(link)
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


def test_without_meshcat_the_study_says_that_there_are_no_pages(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshcat.geometry", None)
    main(["paper", "--figures", "6", "--duration", "1", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert "There are no pages to see in a browser: the browser view needs meshcat" in told
    assert "pip install 'approxjac[view]'" in told
    assert not list(tmp_path.glob("*.html"))


async def watch_and_stop(url):
    """Be a page: get 20 instants, move the target, stop the run, and wait until it has ended."""
    socket = await websocket_connect(url.replace("http", "ws") + "socket")
    rows, message = 0, {}
    while rows < 20:
        message = json.loads(await socket.read_message())
        rows += len(message.get("rows", []))
    last = message["rows"][-1]
    if np.isfinite(np.array(last["target"], dtype=float)).all():
        await socket.write_message(json.dumps({"point": [*last["target"][:2], 0.5]}))
    else:
        (u, v), *_ = last["target_pixels"]
        await socket.write_message(json.dumps({"pixel": [0, u + 5.0, v]}))
    await asyncio.sleep(0.3)
    await socket.write_message(json.dumps({"stop": True}))
    while "ended" not in message:
        message = json.loads(await socket.read_message())
    while await socket.read_message() is not None:
        pass  # until the server has closed it
    socket.close()
    return message["ended"]


@pytest.mark.parametrize("command", ["simulate", "servo"])
def test_a_run_is_shown_and_stopped_from_the_page(command, tmp_path):
    """The results of a run that was stopped are written as those of others."""
    options = ["--duration", "30", "--view", "--speed", "20", "--out", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "approxjac", command, "panda", *options],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={name: value for name, value in os.environ.items() if "DISPLAY" not in name},
    )  # fmt: skip
    first = process.stdout.readline()
    assert first.startswith("No browser could be opened here: open http://127.0.0.1:")
    url = first.split("open ")[1].split(" ")[0]
    with ThreadPoolExecutor() as pool:  # Playwright has an event loop in this thread
        ended = pool.submit(asyncio.run, watch_and_stop(url)).result(60.0)
    out, error = process.communicate(timeout=60)
    assert process.returncode in (0, 1), error
    assert ended.startswith("The run has ended at ")
    assert "verdict" in out
    assert "the target was moved while it ran" in out
    run = aj.Trajectory.load(tmp_path / "run.npz")
    assert 0.0 < run.t[-1] < 30.0


@pytest.mark.parametrize("option", ["--speed", "--port"])
def test_options_of_the_view_need_it(option, tmp_path, capsys):
    assert main(["simulate", "panda", option, "2", "--out", str(tmp_path)]) == 2
    message = f"{option} is for a run that is shown with --view, got 2 without"
    assert message in capsys.readouterr().err


def test_ctrl_c_stops_a_run_that_is_shown_and_keeps_it(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "approxjac", "simulate", "panda", "--duration", "60", "--view",
         "--out", str(tmp_path)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={name: value for name, value in os.environ.items() if "DISPLAY" not in name},
    )  # fmt: skip
    assert "open http" in process.stdout.readline()
    assert process.stdout.readline().startswith("Commands: ")
    process.send_signal(signal.SIGINT)  # while it waits for a page
    out, error = process.communicate(timeout=60)
    assert process.returncode in (0, 1), error
    assert "verdict" in out
    assert aj.Trajectory.load(tmp_path / "run.npz").t[-1] < 60.0
