"""Runs every code block of the README and the docs as a test."""

import gc
import os
import shlex
from pathlib import Path

import pytest
from programs import run_python
from sybil import Sybil
from sybil.example import Example
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser

# Before anything loads NumPy: matrices here are small, and threads only get in each other's way.
os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).parent


def run_console(example: Example) -> None:
    """Run each line of a console block: our command, or Python, from the repository root."""
    for line in example.parsed.splitlines():
        words = shlex.split(line)
        known = {"approxjac": ["-m", "approxjac"], "python": []}
        assert words[0] in known, f"not a command that the tests know how to run: {line}"
        paths = [str(ROOT / word) if (ROOT / word).is_file() else word for word in words[1:]]
        code, _, errors = run_python(*known[words[0]], *paths)
        assert code == 0, errors


@pytest.fixture(scope="module")
def page_folder(tmp_path_factory):
    """A folder of a page's own, for all of its blocks."""
    return tmp_path_factory.mktemp("page")


@pytest.fixture
def scratch(page_folder, monkeypatch):
    """Blocks write their files into a folder that goes away, and find those of earlier blocks."""
    monkeypatch.chdir(page_folder)


pytest_collect_file = Sybil(
    parsers=[PythonCodeBlockParser(), CodeBlockParser("console", run_console)],
    patterns=["README.md", "docs/*.md", "docs/*/*.md"],
    excludes=["docs/_*/*"],  # what is generated, and the built site
    fixtures=["scratch"],
    setup=lambda namespace: namespace.update(__name__="__main__"),  # as in a file of one's own
).pytest()


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Let the garbage collector leave alone what stays to the end: modules, and all the tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)  # with -p no:xdist
def pytest_xdist_make_scheduler(config, log):
    """Give each worker whole files, which share what they load, but each example by itself."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file, _, test = nodeid.partition("::")
            example = test.partition("[")[2].partition("-")[0].rstrip("]")
            return file + example if file.endswith("test_examples.py") else file

    return Scheduling(config, log)


# Files that take long, the longest first: in the end both workers have something to do.
LONG = (
    "test_examples.py", "test_attack_certificate.py", "cli", "test_long_run.py", "browser", "docs",
    "README.md", "test_fuzz_steps.py", "test_watches.py", "test_c99.py", "test_control.py",
    "test_step.py", "test_guard.py", "test_run.py", "test_paper.py",
)  # fmt: skip


def _place(item: pytest.Item) -> int:
    """Return where the file of a test comes among the long ones, or after them."""
    parts = item.path.relative_to(ROOT).parts
    return min((LONG.index(part) for part in parts if part in LONG), default=len(LONG))


@pytest.hookimpl(tryfirst=True)  # before tests are deselected by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of long files first, and mark the code of pages: `study`, for CI.

    Of the README, commands are marked and Python is not.
    """
    for item in items:
        if item.path.suffix == ".md":
            python = getattr(item, "example", None) and item.example.parsed.lstrip()[:1] != "$"
            if item.path.name != "README.md" or not python:
                item.add_marker(pytest.mark.study)
    items.sort(key=_place)
