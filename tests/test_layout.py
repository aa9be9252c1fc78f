"""docs/development/layout.md names what there is, and all packages of the library."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "development" / "layout.md"
TABLE = [
    line.split("|")[1]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if line.startswith("| `")
]
NAMED = [name for cell in TABLE for name in re.findall(r"`([^`]+)`", cell)]


def test_everything_that_is_named_exists():
    assert len(NAMED) > 15
    for name in NAMED:
        path = ROOT / name
        assert path.is_dir() if name.endswith("/") else path.is_file(), name


def test_every_package_and_top_module_is_named():
    source = ROOT / "src" / "approxjac"
    packages = {
        f"{path.parent.relative_to(ROOT).as_posix()}/" for path in source.rglob("*/__init__.py")
    }
    modules = {
        path.relative_to(ROOT).as_posix()
        for path in source.glob("*.py")
        if not path.stem.startswith("__")
    }
    assert packages | modules <= {*NAMED, "src/approxjac/"}


def test_pages_name_only_tests_that_exist():
    """A page that says which file checks something is no use if there is none."""
    for page in (ROOT / "docs").rglob("*.md"):
        for name in re.findall(r"tests/[\w/]+\.py", page.read_text(encoding="utf-8")):
            assert (ROOT / name).is_file(), f"{page.name} names {name}"
