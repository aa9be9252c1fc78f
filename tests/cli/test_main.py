"""The command line as a whole: help, exit codes, output."""

import fcntl
import importlib
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time
from contextlib import suppress

import numpy as np
import pytest

import approxjac as aj
from approxjac.cli import main, options


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "approxjac", *arguments], capture_output=True, text=True, check=False
    )


def help_of(capsys, *command, asked="--help"):
    """What a command prints when it is asked for help."""
    assert main([*command, asked]) == 0
    return capsys.readouterr().out


def test_arguments_that_do_not_parse_give_exit_code_2():
    process = run("paper", "--duration", "ring")
    assert process.returncode == 2
    assert "ring" in process.stderr + process.stdout


def test_help_and_version(capsys):
    process = run("paper", "--help")
    assert process.returncode == 0
    assert "--duration" in process.stdout
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"approxjac {aj.__version__}\n"


def test_the_command_alone_shows_its_help(capsys):
    assert main([]) == 0
    told = capsys.readouterr().out
    assert "Test whether a controller is stable" in told
    assert "Missing" not in told


def test_the_list_of_commands_has_a_line_each_and_their_own_help_has_all(capsys):
    listed, own = help_of(capsys), help_of(capsys, "stability")
    assert "Test whether a controller is stable" in listed
    assert "Exit code 0" not in listed
    assert "Example: approxjac stability panda --object-length 0 0.3" in own
    assert "Exit code 0 if moves or starts in the region are certified" in own


@pytest.mark.parametrize("command", ["simulate", "stability"])
def test_every_length_and_time_in_the_help_has_its_unit(command, capsys):
    text = " ".join(help_of(capsys, command).split("\nOptions\n")[1].split())
    for name in ("--object-length", "--believed-length"):
        assert " m." in text.split(name, 1)[1].split(" --")[0], name
    assert ", s; by default" in text.split("--settling-time", 1)[1].split(" --")[0]


@pytest.mark.parametrize("command", ["simulate", "stability", "export"])
def test_the_help_is_short_and_leads_to_all_options(command, capsys):
    common = help_of(capsys, command).splitlines()
    every = help_of(capsys, command, asked="--help-all").splitlines()
    assert len(common) < 100
    assert max(map(len, [*common, *every])) <= 100
    assert f"approxjac {command} --help-all" in " ".join(common)
    assert "[true.object]" in every
    assert any(line.startswith("  --believed-mass N") for line in common)
    assert "  --sensor.noise N" in {line[:18] for line in every}
    text = "\n".join([*common, *every])
    assert not any(mark in text for mark in ("`", "**", "None", "tuple", "str |"))


def test_a_command_that_does_not_exist_is_one_line_with_what_was_meant(capsys):
    assert main(["simulat", "panda"]) == 2
    assert capsys.readouterr().err == (
        "approxjac: command 'simulat' not in approxjac; did you mean 'simulate'?\n"
    )


def test_the_command_line_imports_nothing_slow():
    code = "import sys, approxjac.cli; print(*sys.modules)"
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = {name.split(".")[0] for name in process.stdout.split()}
    slow = {"matplotlib", "scipy", "meshcat", "trimesh", "mujoco", "osqp", "qpsolvers"}
    assert not slow & loaded


@pytest.mark.long
def test_a_terminal_gets_a_progress_bar(tmp_path):
    controller, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    words = ["paper", "--out", str(tmp_path), "--figures", "6", "--duration", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "approxjac", *words], stdout=subprocess.DEVNULL, stderr=terminal
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
    assert b"figure 6" in shown
    assert b"100 %" in shown


def test_a_reader_that_has_seen_enough_is_no_error():
    words = [sys.executable, "-m", "approxjac", "robots"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() in (0, 128 + 13)  # all was written, or nobody read it


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_stream_that_a_shell_closed_is_no_error(name, monkeypatch):
    monkeypatch.setattr(sys, name, None)
    assert main(["robots", "two_link"]) == 0
    assert main(["robots", "none"]) == 2
    getattr(sys, name).close()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_an_output_that_is_full_is_one_line_with_exit_code_2(monkeypatch, capsys):
    with suppress(OSError), open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["robots", "two_link"]) == 2
        assert capsys.readouterr().err == "approxjac: No space left on device: standard output\n"
        monkeypatch.setattr(sys, "stderr", full)
        assert main(["robots", "none"]) == 2


@pytest.mark.parametrize(
    "count",
    [pytest.param(2, marks=pytest.mark.study), pytest.param(20, marks=pytest.mark.long)],
)
def test_an_interrupt_in_an_import_or_in_a_command_is_one_line_with_exit_code_130(count, tmp_path):
    """At any time from the first import of ours on; before, it is Python's own start."""
    start = (
        # a shell's background ignores it
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "import approxjac.__main__ as command;"
        "sys.argv = ['approxjac', *'simulate two_link --duration 5000 --out made'.split()];"
        "print('begun', flush=True); sys.exit(command.main())"
    )
    for wait in np.linspace(0.0, 2.0, count):
        words = [sys.executable, "-c", start]
        pipes = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE)
        with subprocess.Popen(words, cwd=tmp_path, text=True, **pipes) as process:
            process.stdout.readline()
            time.sleep(0.05 + wait)  # until this program has gone from its print to ours
            process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=10.0)
            except subprocess.TimeoutExpired:  # Python ignores one within a weakref's callback
                process.send_signal(signal.SIGINT)
            said = process.stderr.read().strip()
            assert said.endswith("approxjac: stopped"), wait
            assert "Traceback" not in said or "Exception ignored" in said
            assert process.wait() in (130, -signal.SIGINT)  # which a shell shows as 130, too
        assert not (tmp_path / "made").exists() or not [*(tmp_path / "made").iterdir()]


def test_an_interrupt_while_commands_are_imported_is_told_as_later_ones(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("approxjac.cli.main", interrupted)
    assert importlib.import_module("approxjac.__main__").main() == 130
    assert capsys.readouterr().err.strip() == "approxjac: stopped"


def test_a_bar_says_what_it_does_how_long_it_took_and_how_long_it_will():
    with options.time_bar(10.0, "simulation", disable=False) as bar:
        bar.update(5.0)
        shown = str(bar)
    assert shown.startswith("simulation: 5.0 of 10 s, 50 %|")
    assert " so far, " in shown
    assert shown.endswith(" to go")


@pytest.mark.parametrize("columns", [44, 60])
def test_a_narrow_terminal_has_half_of_its_width_for_the_texts(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    lines = help_of(capsys, "robots").splitlines()
    texts = [line for line in lines if line.startswith("   ")]
    assert max(map(len, texts)) <= columns
    assert {len(line) - len(line.lstrip()) for line in texts} == {min(26, columns // 2)}


@pytest.mark.parametrize("command", ["simulate", "stability", "view"])
def test_the_help_says_what_a_command_is_given(command, capsys):
    """The word after it is explained above the options."""
    usage, *lines = help_of(capsys, command).splitlines()
    word = usage.split()[3]
    at = lines.index("Options")
    assert any(line.startswith(f"  {word} ") for line in lines[:at])
