"""Files are written whole or not at all."""

import os
import subprocess
import sys

import numpy as np
import pytest

import approxjac as aj
from approxjac import view
from approxjac.cli import main
from approxjac.files import replaced, together, write_text


def write_half(path):
    with replaced(path) as unfinished:
        unfinished.write_text("half")
        raise ZeroDivisionError


def test_what_fails_leaves_what_was_there(tmp_path):
    path = tmp_path / "text.txt"
    write_text(path, "before")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "after \ud800")
    with pytest.raises(ZeroDivisionError):
        write_half(path)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
    write_text(path, "after")
    assert path.read_text() == "after"


def test_files_that_belong_together_come_together(tmp_path):
    for name in ("a", "b"):
        write_text(tmp_path / name, "before")

    def write(text, breaks):
        with together(tmp_path) as folder:
            write_text(folder / "a", text)
            write_text(folder / "c", text)
            if breaks:
                raise ZeroDivisionError
        return {path.name: path.read_text() for path in tmp_path.iterdir()}

    with pytest.raises(ZeroDivisionError):
        write("half", breaks=True)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "a": "before", "b": "before"
    }  # fmt: skip
    assert write("after", breaks=False) == {"a": "after", "b": "before", "c": "after"}
    with pytest.raises(FileNotFoundError, match="nowhere"), together(tmp_path / "nowhere"):
        pass


@pytest.mark.usefixtures("blank_pictures")
def test_a_command_that_breaks_off_leaves_the_files_of_the_one_before(tmp_path, monkeypatch):
    words = ["simulate", "two_link", "--duration", "0.5", "--out", str(tmp_path)]
    main(words)
    kept = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert {path.name for path in kept} == {
        "run.png", "run.svg", "run.npz", "summary.json", "scenario.toml", "kinematics.txt"
    }  # fmt: skip

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("approxjac.scenario.outcome.write_text", full)  # the last file of all
    assert main([*words, "--seed", "3"]) == 2
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == kept


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path):
    """As a write gives it, without a name; also where another error's text has the file's name."""

    def write():
        with together(tmp_path) as folder:
            write_text(folder / "a", "of those that belong together")
            with replaced(folder / "b") as unfinished:
                unfinished.write_text("half")
                raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left") as raised:
        write()
    assert raised.value.filename == str(tmp_path / "b")
    with (
        pytest.raises(aj.InvalidInputError, match="got ") as invalid,
        together(tmp_path) as folder,
    ):
        raise aj.InvalidInputError(f"path must be writable, got {folder / 'c'}")
    assert str(invalid.value).endswith(str(tmp_path / "c"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.study
@pytest.mark.skipif(os.name != "posix", reason="limits of a file's size are POSIX")
@pytest.mark.parametrize(
    "words",
    [
        "simulate two_link --duration 0.05",
        "export two_link",
        *(pytest.param(each, marks=pytest.mark.long) for each in ("stability two_link", "paper")),
    ],
)
def test_a_command_on_a_full_disk_names_a_file_and_leaves_none(words, tmp_path):
    import resource

    option = "--folder" if words.startswith("export") else "--out"
    # the limit would cut off what Python keeps of a changed module: then nothing can import it
    environment = {**os.environ, "APPROXJAC_CACHE": "off", "PYTHONDONTWRITEBYTECODE": "1"}
    run = subprocess.run(
        [sys.executable, "-m", "approxjac", *words.split(), option, "made"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000)),
        cwd=tmp_path, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    assert run.returncode == 2
    assert "File too large" in run.stderr
    assert "made/" in run.stderr
    assert "Traceback" not in run.stderr
    assert list((tmp_path / "made").iterdir()) == []


def test_a_folder_is_not_replaced(tmp_path):
    with pytest.raises(IsADirectoryError), replaced(tmp_path):
        pass
    assert tmp_path.is_dir()


def test_a_run_and_a_picture_that_break_off_leave_the_ones_before(tmp_path, monkeypatch):
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    law = aj.SetpointController(task, aj.Gains(400.0, 80.0))
    q = np.array([0.6, 1.2])
    run = aj.simulate(aj.Plant(arm, task), law, task.value(q) + 0.05, q, duration=0.1)
    figure, axes = view.new_figure(1, title="error")
    view.plot_error(run, axes[0])
    kept = {path: path.read_bytes() for path in view.save_figure(figure, tmp_path / "error")}
    path = run.save(tmp_path / "run")
    kept[path] = path.read_bytes()

    def full(file, *_, **__):
        file.write(b"half") if hasattr(file, "write") else file.write_bytes(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    monkeypatch.setattr(figure, "savefig", full)
    with pytest.raises(aj.errors.TrajectoryFileError, match="no space left"):
        run.save(tmp_path / "run")
    with pytest.raises(aj.InvalidInputError, match="no space left"):
        view.save_figure(figure, tmp_path / "error")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == kept
