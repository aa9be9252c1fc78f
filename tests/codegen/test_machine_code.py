"""Machine code that is kept: in this process, and in a folder for the next one."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from approxjac.codegen.backends import machine_code
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.machine_code import Counts, MachineCode, cache_folder
from approxjac.codegen.trace.program import Program

SCRIPT = """
import json, sys
import numpy as np
import approxjac as aj
from approxjac.codegen.backends.machine_code import MachineCode

arm = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
task = aj.PositionTask(arm, axes="xz")
law = aj.codegen.compiled(aj.SetpointController(task))
q, target = np.array([0.4, 0.9]), task.value(np.array([0.6, 0.7]))
run = aj.simulate(aj.Plant(arm, task), law, target, q, 3.0, record_every=0.1)
errors = aj.Uncertainty(arm, friction=0.1)
study = aj.Study(aj.SetpointController(task), errors,
                 aj.JointBox.around(arm, q, 0.1), seed=int(sys.argv[1]), duration=0.1)
study.rollouts(8)
print(json.dumps([*MachineCode.counts, *run.q[-1].tolist()]))
"""


def program(number=2.0):
    found = Program()
    x = found.kept("x", 3)
    found.step({"x": np.sin(x) * number + x[::-1]})
    return found


def outcome(of):
    kept = np.array([[[0.1], [0.2], [0.3]]])
    LlvmLanes(of, 1).run(kept, np.zeros((1, 1, 1)))
    return kept.ravel().tolist()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of its own, and a process that knows nothing."""
    monkeypatch.setenv("APPROXJAC_CACHE", str(tmp_path / "cache"))
    forget(monkeypatch)
    return tmp_path / "cache"


def forget(monkeypatch):
    monkeypatch.setattr(MachineCode, "_known", type(MachineCode._known)())
    monkeypatch.setattr(MachineCode, "counts", Counts())


def test_the_same_program_is_compiled_once(folder, monkeypatch):
    expected = outcome(program())
    assert outcome(program()) == expected
    assert MachineCode.counts == Counts(1, 0, 1)
    forget(monkeypatch)
    assert outcome(program()) == expected
    assert outcome(program(3.0)) != expected
    assert MachineCode.counts == Counts(1, 1, 0)
    assert len(list(folder.iterdir())) == 2


DAMAGE = {
    "nothing left": lambda data, other: b"",
    "cut off": lambda data, other: data[:-7],
    "longer": lambda data, other: data + b"\0",
    "a bit": lambda data, other: data[:600] + bytes([data[600] ^ 4]) + data[601:],
    "another's": lambda data, other: other,
    "text": lambda data, other: b"<html>",
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_what_is_damaged_is_compiled_again(folder, monkeypatch, damage):
    outcome(program(3.0))
    (other,) = folder.iterdir()
    expected = outcome(program())
    (own,) = set(folder.iterdir()) - {other}
    whole = own.read_bytes()
    own.write_bytes(damage(whole, other.read_bytes()))
    forget(monkeypatch)
    assert outcome(program()) == expected
    assert MachineCode.counts == Counts(1, 0, 0)
    assert own.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path, folder, monkeypatch):
    expected = outcome(program())
    (own,) = folder.iterdir()
    own.unlink()
    own.mkdir()
    for where in (str(folder), str(tmp_path / "file" / "cache"), "/dev/null/cache"):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("APPROXJAC_CACHE", where)
        forget(monkeypatch)
        assert outcome(program()) == expected
        assert MachineCode.counts == Counts(1, 0, 0)


def test_what_was_not_used_for_longest_goes(folder, monkeypatch):
    numbers = (2.0, 3.0, 4.0)
    for i, number in enumerate(numbers):
        before = set(folder.glob("*"))
        outcome(program(number))
        (new,) = set(folder.glob("*")) - before
        os.utime(new, (1000 + i, 1000 + i))
    forget(monkeypatch)
    outcome(program(2.0))  # used again
    monkeypatch.setattr(machine_code, "_ON_DISK", 3 * new.stat().st_size)
    outcome(program(5.0))
    assert len(list(folder.iterdir())) <= 3
    forget(monkeypatch)
    outcome(program(2.0))
    outcome(program(3.0))
    assert MachineCode.counts == Counts(1, 1, 0)


def test_where_code_is_kept(tmp_path, monkeypatch):
    for off in ("0", "off", "OFF", " no ", ""):
        monkeypatch.setenv("APPROXJAC_CACHE", off)
        assert cache_folder() is None
    monkeypatch.setenv("APPROXJAC_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("APPROXJAC_CACHE")
    if sys.platform == "linux":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert cache_folder() == tmp_path / "approxjac"
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        assert cache_folder() == tmp_path / "home" / ".cache" / "approxjac"


def started(cache, seed=0):
    own = os.environ | {"APPROXJAC_CACHE": str(cache)}
    command = [sys.executable, "-c", SCRIPT, str(seed)]
    return subprocess.Popen(command, env=own, stdout=subprocess.PIPE, text=True)


def answer(process):
    text, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    compiled, read, shared, *q = json.loads(text)
    return Counts(compiled, read, shared), q


def test_a_second_start_compiles_nothing(tmp_path):
    first, race = started(tmp_path / "a"), started(tmp_path / "a")  # of one folder, at once
    (counts, q), (others, same) = answer(first), answer(race)
    total = counts.compiled + counts.read
    assert q == same
    assert total == others.compiled + others.read >= 3
    assert counts.compiled + others.compiled >= total
    again, q_again = answer(started(tmp_path / "a", seed=1))
    assert again[:2] == (0, total)
    assert q_again == q
    without, _ = answer(started("off"))
    assert without[:2] == (total, 0)
