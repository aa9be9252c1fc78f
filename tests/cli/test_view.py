"""`approxjac view`, and `simulate --view`."""

import asyncio
import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partialmethod
from pathlib import Path

import numpy as np
import pytest
from tornado.websocket import websocket_connect

import approxjac as aj
from approxjac.cli import main
from approxjac.scenario import Scenario


@pytest.fixture(scope="module")
def reached(tmp_path_factory):
    """A short run, as `simulate` leaves it."""
    out = tmp_path_factory.mktemp("reached")
    with contextlib.redirect_stdout(io.StringIO()) as told:
        assert main(["simulate", "two_link", "--duration", "0.5", "--out", str(out)]) in (0, 1)
    assert f"See it move: approxjac view {out / 'run.npz'}" in told.getvalue()
    return out


@pytest.mark.study
def test_a_run_becomes_a_page(reached, tmp_path, capsys):
    for given in (reached, reached / "run.npz"):
        page = tmp_path / f"{given.name}.html"
        assert main(["view", str(given), "--out", str(page), "--title", "Seen <here>"]) == 0
        assert capsys.readouterr().out == f"{page}\n"
        assert "<title>Seen &lt;here&gt;</title>" in page.read_text(encoding="utf-8")
        assert page.stat().st_size < 4_000_000


@pytest.mark.study
def test_a_page_beside_its_run_is_opened(reached, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr(
        "approxjac.view.browser.page.open_browser", lambda url: opened.append(url) or True
    )
    assert main(["view", str(reached)]) == 0
    page = reached / "run.html"
    assert opened == [page.resolve().as_uri()]
    assert capsys.readouterr().out == f"{page}\n"
    monkeypatch.setattr("approxjac.view.browser.page.open_browser", lambda url: False)
    assert main(["view", str(reached)]) == 0
    assert "No browser could be opened here: open it in yours" in capsys.readouterr().out


def test_what_is_no_run_is_a_clear_error(reached, tmp_path, capsys):
    (tmp_path / "two").mkdir()
    for name in ("a.npz", "b.npz"):
        (tmp_path / "two" / name).touch()
    (tmp_path / "old.npz").write_bytes(b"no run")
    for given, message in (
        (tmp_path / "two", "RUN must be a file, or a folder with one run (.npz)"),
        (tmp_path / "two", "with a.npz, b.npz"),
        (tmp_path, "is not a trajectory written by"),
        (tmp_path / "gone.npz", "does not exist"),
    ):
        assert main(["view", str(given)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("approxjac: ")
        assert message in error
        assert error.count("\n") == 1
    assert main(["view", str(reached), "--out", str(tmp_path / "no" / "page.html")]) == 2
    assert "--out must be a file in an existing folder" in capsys.readouterr().err


async def watch_and_stop(url):
    """Be a page: get 20 instants, move the target, stop the run, and wait until it has ended."""
    socket = await websocket_connect(url.replace("http", "ws") + "socket")
    rows, message = 0, {}
    while rows < 20:
        message = json.loads(await socket.read_message())
        rows += len(message.get("rows", []))
    last = message["rows"][-1]
    if np.isfinite(np.array(last["target"], dtype=float)).all():
        await socket.write_message(json.dumps({"point": [*last["target"][:2], 0.5]}))
    else:
        (u, v), *_ = last["target_pixels"]
        await socket.write_message(json.dumps({"pixel": [0, u + 5.0, v]}))
    await asyncio.sleep(0.3)
    await socket.write_message(json.dumps({"stop": True}))
    while "ended" not in message:
        message = json.loads(await socket.read_message())
    while await socket.read_message() is not None:
        pass  # until the server has closed it
    socket.close()
    return message["ended"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "certified"),
    # by part in test_live.py, test_stability.py and the docs, where it is simulated
    [("reach", True), ("camera", False)],
)
def test_the_same_file_is_simulated_analysed_and_shown(name, certified, tmp_path, monkeypatch):
    """And a run that was stopped from the page is written as others are."""
    local = partialmethod(aj.Study.tolerance, tests=("stable",), draws=20)  # test_stability.py
    monkeypatch.setattr(aj.Study, "tolerance", local)
    file = Path(__file__).parents[2] / "examples" / "scenarios" / f"{name}.toml"
    folders = ran, analysed, shown = [tmp_path / each for each in ("ran", "analysed", "shown")]
    assert main(["simulate", str(file), "--out", str(ran)]) == 0
    quick = ["--configurations", "20", "--runs", "0", "--map-points", "0"]
    assert main(["stability", str(file), *quick, "--out", str(analysed)]) == (not certified)
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "approxjac", "simulate", str(file), "--view", "--speed", "10",
         "--out", str(shown)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={name: value for name, value in os.environ.items() if "DISPLAY" not in name},
    )  # fmt: skip
    first = process.stdout.readline()
    assert first.startswith("No browser could be opened here: open http://127.0.0.1:")
    url = first.split("open ")[1].split(" ")[0]
    with ThreadPoolExecutor() as pool:  # Playwright has an event loop in this thread
        ended = pool.submit(asyncio.run, watch_and_stop(url)).result(60.0)
    out, error = process.communicate(timeout=60)
    assert process.returncode in (0, 1), error
    assert ended.startswith("The run has ended at ")
    assert "converged" in out
    assert "the target was moved while it ran" in out
    scenario = Scenario.load(file)
    assert 0.0 < aj.Trajectory.load(shown / "run.npz").t[-1] < scenario.run.duration
    assert (
        Scenario.load(ran / "scenario.toml") == scenario == Scenario.load(shown / "scenario.toml")
    )
    gains = [json.loads((each / "summary.json").read_text())["gains"] for each in folders]
    assert gains[0] == gains[1] == gains[2]


@pytest.mark.long
def test_ctrl_c_stops_a_run_that_is_shown_and_keeps_it(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "approxjac", "simulate", "two_link", "--duration", "60",
         "--view", "--out", str(tmp_path)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={name: value for name, value in os.environ.items() if "DISPLAY" not in name},
    )  # fmt: skip
    assert "open http" in process.stdout.readline()
    process.send_signal(signal.SIGINT)  # while it waits for a page
    out, error = process.communicate(timeout=60)
    assert process.returncode in (0, 1), error
    assert "stopped after 0 s" in out or "converged" in out
    assert aj.Trajectory.load(tmp_path / "run.npz").t[-1] < 60.0
