"""The shape of the package: which folder may import which, and what an import costs."""

import ast
import functools
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import approxjac

SOURCE = Path(approxjac.__file__).parent

# Each may import itself and what stands in its set; nothing else of ours.
ALLOWED = {
    "errors": set(),
    "files": {"errors"},
    "formatting": set(),
    "validation": {"errors", "formatting"},
    "interface": {"errors", "formatting", "tasks", "validation"},
    "paths": {"errors", "formatting", "interface", "validation"},
    "robots": {"errors", "files", "formatting", "validation"},
    "law": {"errors", "validation"},
    "codegen": {
        "__init__", "cameras", "controllers", "errors", "files", "formatting",
        "interface", "law", "robots", "simulation", "tasks", "validation",
    },
    "cameras": {"errors", "files", "formatting", "law", "robots", "validation"},
    "tasks": {"cameras", "errors", "formatting", "law", "robots", "validation"},
    "controllers": {
        "cameras", "errors", "formatting", "interface", "law", "robots", "tasks",
        "validation",
    },
    "calibration": {
        "controllers", "errors", "files", "formatting", "law", "robots", "validation",
    },
    "simulation": {
        "__init__", "cameras", "controllers", "errors", "files", "formatting",
        "interface", "law", "robots", "tasks", "validation",
    },
    "realtime": {
        "controllers", "errors", "formatting", "interface", "robots", "simulation",
        "tasks", "validation",
    },
    "stability": {
        "cameras", "codegen", "controllers", "errors", "files", "formatting",
        "interface", "law", "robots", "simulation", "tasks", "validation",
    },
    "view": {
        "calibration", "cameras", "controllers", "errors", "files", "formatting", "interface",
        "law", "robots", "simulation", "tasks", "validation",
    },
    "paper": {
        "cameras", "controllers", "errors", "formatting", "law", "robots", "simulation",
        "stability", "tasks", "validation", "view",
    },
    "scenario": {
        "cameras", "controllers", "errors", "files", "formatting", "interface", "law", "paths",
        "robots", "simulation", "stability", "tasks", "validation", "view",
    },
    "cli": {
        "__init__", "calibration", "codegen", "controllers", "errors", "files", "formatting",
        "paper", "robots", "scenario", "simulation", "stability", "view",
    },
    "__main__": {"cli"},
}  # fmt: skip


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def imports_of(path):
    """Absolute names of everything that a file imports, wherever in the file."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "approxjac":
                yield from (f"approxjac.{alias.name}" for alias in node.names)
            else:
                yield str(node.module)


FILES = sorted(SOURCE.rglob("*.py"))


def part_of(path):
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SOURCE)))
def test_imports_point_one_way(path):
    part = part_of(path)
    if part == "__init__":
        return
    for name in imports_of(path):
        if name == "approxjac" or name.startswith("approxjac."):
            other = f"{name}.__init__".split(".")[1]
            assert other == part or other in ALLOWED[part], f"{part} must not import {name}"


def test_every_part_is_listed():
    assert {part_of(path) for path in FILES} == {*ALLOWED, "__init__"}


def test_the_law_knows_only_numpy():
    for path in (SOURCE / "law").glob("*.py"):
        for name in imports_of(path):
            top = name.split(".")[0]
            assert top in {"numpy", "approxjac"} or top in sys.stdlib_module_names


def test_rooms_are_small():
    rooms = Counter(path.parent.relative_to(SOURCE).as_posix() for path in FILES)
    named = {"__init__.py", "__main__.py"}
    rooms -= Counter(
        path.parent.relative_to(SOURCE).as_posix() for path in FILES if path.name in named
    )
    most = {"law": 20}
    assert {room: n for room, n in rooms.items() if n > most.get(room, 15)} == {}


MODULES = {
    ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in FILES
}


def imported_at_once(path):
    """Modules of ours that a file imports at its top, or there for type checkers."""
    for node in parsed(path).body:
        for each in node.body if isinstance(node, ast.If) else [node]:
            if isinstance(each, ast.ImportFrom):
                for alias in each.names:
                    whole = f"{each.module}.{alias.name}"
                    yield whole if whole in MODULES else each.module


def test_imports_have_no_circle():
    left = {
        name: {other for other in imported_at_once(path) if other in MODULES} - {name}
        for name, path in MODULES.items()
    }
    while done := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in done}
    assert left == {}


def test_no_name_is_used_twice():
    """Public classes, and modules but for those that mirror one of `law`."""
    modules = Counter(path.stem for path in FILES if not path.stem.startswith("__"))
    mirrored = {path.stem for path in (SOURCE / "law").glob("*.py")}
    assert {name for name, n in modules.items() if n > 1 + (name in mirrored)} == set()
    classes = Counter(
        node.name
        for path in FILES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert {name for name, n in classes.items() if n > 1} == set()


def loaded_by(statement):
    code = f"import sys\n{statement}\nprint(*sys.modules)"
    output = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    return {name.split(".")[0] for name in output.split()}


def test_an_import_loads_nothing_heavy():
    extra = loaded_by("import approxjac") - loaded_by("import pinocchio")
    third_party = {
        name
        for name in extra
        if name not in sys.stdlib_module_names and not name.startswith(("_", "approxjac"))
    }
    assert third_party <= {"lxml", "cython_runtime"}  # what reads URDFs


def test_stability_is_loaded_when_it_is_asked_for():
    code = (
        "import sys, approxjac as aj\n"
        "assert not {'approxjac.stability', 'approxjac.view'} & set(sys.modules)\n"
        "assert set(aj.__all__) <= set(dir(aj))\n"
        "assert {'stability', 'view', 'errors'} <= set(dir(aj))\n"
        "assert not {'Any', 'importlib', 'TYPE_CHECKING', 'interface'} & set(dir(aj))\n"
        "assert aj.view.plot_run.__module__ == 'approxjac.view.plots'\n"
        "from approxjac import Study\n"
        "assert Study is aj.stability.Study is aj.Study\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert all(hasattr(approxjac, name) for name in approxjac.__all__)
    with pytest.raises(AttributeError, match="module 'approxjac' has no attribute 'stabilty'"):
        approxjac.stabilty  # noqa: B018
