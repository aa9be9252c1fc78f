"""Files are written whole or not at all."""

import numpy as np
import pytest

import approxjac as aj
from approxjac import view
from approxjac.files import replaced, write_text


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
