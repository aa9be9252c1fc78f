"""Machine code that is kept: in this process, and in a folder for the next one."""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from approxjac.codegen.backends import machine_code
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.machine_code import MachineCode, cache_folder
from approxjac.codegen.trace.program import Program

SCRIPT = """
import json, sys
from codegen.test_machine_code import counting, counts, machine_code
for name in ("_compiled", "_read"):
    setattr(machine_code, name, counting(name))
import numpy as np
import approxjac as aj

arm = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
task = aj.PositionTask(arm, axes="xz")
law = aj.codegen.compiled(aj.SetpointController(task))
q, target = np.array([0.4, 0.9]), task.value(np.array([0.6, 0.7]))
run = aj.simulate(aj.Plant(arm, task), law, target, q, 3.0, record_every=0.1)
errors = aj.Uncertainty(arm, friction=0.1)
study = aj.Study(aj.SetpointController(task), errors,
                 aj.JointBox.around(arm, q, 0.1), seed=int(sys.argv[1]), duration=0.1)
study.rollouts(8)
print(json.dumps([counts["_compiled"], counts["_read"], *run.q[-1].tolist()]))
"""


counts = Counter()


def counting(name):
    """A function of machine_code that counts what it returns."""
    function = getattr(machine_code, name)

    def counted(*arguments):
        found = function(*arguments)
        counts[name] += found is not None
        return found

    return counted


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
    """A folder of its own, and a process that knows nothing, and counts."""
    monkeypatch.setenv("APPROXJAC_CACHE", str(tmp_path / "cache"))
    for name in ("_compiled", "_read"):
        monkeypatch.setattr(machine_code, name, counting(name))
    forget(monkeypatch)
    return tmp_path / "cache"


def forget(monkeypatch):
    monkeypatch.setattr(MachineCode, "_known", type(MachineCode._known)())
    counts.clear()


def test_the_same_program_is_compiled_once(folder, monkeypatch):
    expected = outcome(program())
    assert outcome(program()) == expected
    assert counts == {"_compiled": 1, "_read": 0}
    forget(monkeypatch)
    assert outcome(program()) == expected
    assert outcome(program(3.0)) != expected
    assert counts == {"_compiled": 1, "_read": 1}
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
    assert counts == {"_compiled": 1, "_read": 0}
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
        assert counts == {"_compiled": 1, "_read": 0}


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
    assert counts == {"_compiled": 1, "_read": 1}


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
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    own = os.environ | {"APPROXJAC_CACHE": str(cache), "PYTHONPATH": paths}
    command = [sys.executable, "-c", SCRIPT, str(seed)]
    return subprocess.Popen(command, env=own, stdout=subprocess.PIPE, text=True)


def answer(process):
    text, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    compiled, read, *q = json.loads(text)
    return (compiled, read), q


@pytest.mark.study
def test_a_second_start_compiles_nothing(tmp_path):
    first, race = started(tmp_path / "a"), started(tmp_path / "a")  # of one folder, at once
    ((compiled, read), q), (others, same) = answer(first), answer(race)
    assert q == same
    assert compiled + read == sum(others) >= 3
    assert compiled + others[0] >= compiled + read
    assert answer(started(tmp_path / "a", seed=1)) == ((0, compiled + read), q)
    assert answer(started("off"))[0] == (compiled + read, 0)
