"""The shape of the package: which folder may import which, and what an import costs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import approxjac

SOURCE = Path(approxjac.__file__).parent

# Each may import itself and what stands in its set; nothing else of ours.
ALLOWED = {
    "errors": set(),
    "extras": {"errors"},
    "files": set(),
    "formatting": set(),
    "validation": {"errors"},
    "interface": {"tasks", "validation", "formatting", "errors"},
    "paths": {"interface", "formatting", "validation", "errors"},
    "robots": {"files", "validation", "errors"},
    "law": {"validation", "errors"},
    "codegen": {
        "files", "simulation", "controllers", "law", "tasks", "robots", "interface", "formatting",
        "validation", "errors", "extras", "__init__",
    },
    "tasks": {"robots", "formatting", "validation", "errors"},
    "controllers": {
        "law", "tasks", "robots", "interface", "formatting", "validation", "errors", "extras",
    },
    "simulation": {
        "files", "controllers", "law", "tasks", "robots", "interface", "formatting", "validation",
        "errors",
        "extras", "__init__",
    },
    "realtime": {
        "simulation", "controllers", "tasks", "robots", "interface", "formatting", "validation",
        "errors", "extras",
    },
    "stability": {
        "files", "codegen", "controllers", "simulation", "law", "tasks", "robots", "interface",
        "formatting", "validation", "errors", "extras",
    },
    "view": {
        "files", "simulation", "controllers", "law", "tasks", "robots", "interface", "validation",
        "errors",
        "extras",
    },
    "paper": {
        "view", "stability", "controllers", "simulation", "law", "tasks", "robots", "formatting",
        "validation", "errors",
    },
    "scenario": {
        "files", "view", "stability", "controllers", "simulation", "law", "tasks", "robots",
        "paths",
        "interface", "formatting", "validation", "errors",
    },
    "cli": {
        "files", "scenario", "paper", "view", "stability", "codegen", "controllers", "simulation",
        "robots", "formatting", "errors", "__init__",
    },
    "__main__": {"cli"},
}  # fmt: skip


def imports_of(path):
    """Absolute names of everything that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
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


def test_modules_are_small():
    sizes = {str(path): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    assert {path: n for path, n in sizes.items() if n > 400} == {}


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
        "from approxjac import stability_report\n"
        "assert stability_report is aj.stability.stability_report is aj.stability_report\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert all(hasattr(approxjac, name) for name in approxjac.__all__)
    with pytest.raises(AttributeError, match="module 'approxjac' has no attribute 'stabilty'"):
        approxjac.stabilty  # noqa: B018
