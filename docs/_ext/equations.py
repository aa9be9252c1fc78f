"""The table equation → function → tests: of the docstrings of `approxjac.law`, and the rest."""

import functools
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import approxjac.law

ROOT = Path(__file__).parents[2]
ELSEWHERE = [  # equations that are no function of `approxjac.law`, and where they are
    (11, "step of the proof: V̇ = −W", ["tests/stability/test_lyapunov.py"]),
    (15, "`stability.theorem1`: c₀ and c₁ over a region", ["tests/stability/test_certificate.py"]),
    *((number, "used in the proof only", []) for number in (16, 17, 18, 19)),
    (20, "`stability.theorem1`: λ₁ over a region", ["tests/stability/test_certificate.py"]),
    (26, "step of the proof: V̇ ≤ 0", ["tests/stability/test_lyapunov.py"]),
    (32, "`jacobian` of an `ImageTask` of the true robot", ["tests/tasks/test_image.py"]),
    (33, "`jacobian` of an `ImageTask` of the believed robot", ["tests/tasks/test_image.py"]),
]
MARK = re.compile(r"Implements\s+Eq\.\s+\((\d+)\)(,\s+too)?")


def members():
    """Every function and class of `approxjac.law`, with the module it is defined in."""
    for info in pkgutil.iter_modules(approxjac.law.__path__):
        module = importlib.import_module(f"approxjac.law.{info.name}")
        for name, member in vars(module).items():
            if getattr(member, "__module__", None) == module.__name__ and not name.startswith("_"):
                yield name, member


def tests_of(number, name):
    """Names of test files that use a name of the law, or say that they test its equation."""
    return sorted(test for test, used in uses() if {name, f"{number}"} & used)


@functools.cache
def uses():
    """Names of test files, each with what it uses of the law, and numbers of equations."""
    pattern, found = re.compile(r"\b(?:(?:aj\.)?law|aj)\.(\w+)|Eq\. \((\d+)\)"), []
    for path in (ROOT / "tests").rglob("test_*.py"):
        words = pattern.findall(path.read_text(encoding="utf-8"))
        found.append((path.name, {word for pair in words for word in pair}))
    return found


def implemented(text):
    """Numbers of the equations that a docstring implements, each with its departure.

    A departure belongs to the equation named before it, and with "too" to the one before that.
    """
    found, after, shared = [], len(text), ""
    for mark in reversed(list(MARK.finditer(text))):
        said = re.search(r"Departures?:(.*?)(?:\n\n|\Z)", text[mark.end() : after], re.DOTALL)
        note = " ".join(said.group(1).split()) if said else shared
        found.append((int(mark[1]), note))
        after, shared = mark.start(), note if mark[2] else ""
    return found[::-1]


def rows():
    """Equation number, function, its docstring's departure, and its tests."""
    found = []
    for name, member in members():
        for number, note in implemented(inspect.getdoc(member) or ""):
            found.append((number, f"`law.{name}`", note, tests_of(number, name)))
    found += [(number, where, "", tests) for number, where, tests in ELSEWHERE]
    return sorted(found)


def in_maths(note):
    """A note as Markdown, in which K_v and λ_min are formulas."""
    note = re.sub(r"([A-Za-zλ])_([a-z]{2,})", r"$\1_{\\mathrm{\2}}$", note)
    return re.sub(r"([A-Za-zλ])_([a-z])", r"$\1_\2$", note)


def table():
    """The table as Markdown."""
    lines = ["| Eq. | in `approxjac` | departure from the print | tests |", "|---|---|---|---|"]
    for number, name, departure, tests in rows():
        lines.append(
            f"| ({number}) | {name} | {in_maths(departure) or '–'} | "
            f"{', '.join(f'`{test}`' for test in tests) or '–'} |"
        )
    return "\n".join(lines) + "\n"


def write(app):
    folder = Path(app.srcdir) / "_generated"
    folder.mkdir(exist_ok=True)
    (folder / "equations.md").write_text(table(), encoding="utf-8")


def setup(app):
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
