"""Code blocks of every page are tests, also those of pages in folders that come later."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_every_page_with_code_is_collected():
    inside = [path.relative_to(ROOT) for path in (ROOT / "docs").rglob("*.md")]
    pages = [path for path in inside if not any(part.startswith("_") for part in path.parts)]
    with_code = {
        str(path)
        for path in [*pages, Path("README.md")]
        if {"```python", "```console"} & set((ROOT / path).read_text("utf-8").splitlines())
    }
    options = ["-n", "0", "-m", "", "--collect-only", "-q"]
    command = [sys.executable, "-m", "pytest", *options, "docs", "README.md"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    collected = {line.partition("::")[0] for line in listed.splitlines() if "::" in line}
    assert "docs/how_to/tool_length.md" in with_code
    assert collected == with_code
