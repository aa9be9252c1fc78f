"""The studies' commands, until they are scripts."""

import json

from approxjac.cli import main


def test_arms_writes_a_table(tmp_path, capsys):
    words = ["arms", "--robots", "ur5", "--starts", "1", "--duration", "8", "--jobs", "2"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| ur5 | 20 cm, 0.5 kg | 1 of 1 |" in table
    assert table in capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["verdict"] == "ok"
    assert len(summary["runs"]) == 2


def test_limiters_writes_a_table_a_picture_and_a_summary(tmp_path, capsys):
    words = ["--robots", "two_link", "--scales", "0.5", "--starts", "1", "--duration", "1"]
    assert main(["limiters", *words, "--jobs", "1", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| two_link | × 0.5 | 1 |" in table
    out = capsys.readouterr().out
    assert table in out
    assert "all kept" in out
    assert {path.name for path in tmp_path.iterdir()} == {
        "limiters.png", "limiters.svg", "summary.json", "table.md",
    }  # fmt: skip
    assert json.loads((tmp_path / "summary.json").read_text())["verdict"] == "ok"


def test_limiters_that_fall_short_give_exit_code_1(tmp_path, capsys, monkeypatch):
    from approxjac.studies import limiters_report

    monkeypatch.setattr(limiters_report, "shortcomings", lambda outcomes: ["it broke a limit"])
    words = ["--robots", "two_link", "--scales", "1", "--starts", "1", "--duration", "0.1"]
    assert main(["limiters", *words, "--jobs", "1", "--out", str(tmp_path)]) == 1
    assert "fell short: it broke a limit" in capsys.readouterr().out
