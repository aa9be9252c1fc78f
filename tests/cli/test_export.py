"""`approxjac export`: the controller of a scenario as C, and what it refuses."""

import pytest

import approxjac as aj
from approxjac.cli import main
from approxjac.codegen.backends.c99 import constant
from approxjac.law.guard import UNSEEN
from approxjac.scenario import Scenario, build_scenario

LEARNS = ("--controller.law", "tracking", "--controller.unknown", "tool", "origins", "camera")


def export(folder, *options):
    return main(["export", *options, "--folder", str(folder)])


@pytest.mark.study
def test_it_writes_the_controller_of_the_scenario(tmp_path, capsys):
    assert export(tmp_path / "made", "panda", "--believed-length", "0.1", "--effort-only") == 0
    said = capsys.readouterr().out
    assert "set-point law (28)" in said
    assert "controller.h says how to call it" in said
    built = build_scenario(Scenario("panda", believed={"object": {"length": 0.1}}))
    expected = aj.TorqueLimited(built.law, aj.Limits(effort=built.limits.effort), dt=1e-3)
    aj.export_c(expected, tmp_path / "expected")
    for name in ("controller.h", "controller.c"):
        made, wanted = ((tmp_path / each / name).read_bytes() for each in ("made", "expected"))
        assert made == wanted


def test_a_file_and_options_say_the_same(tmp_path):
    scenario = Scenario("ur5", controller={"limits": "none", "gravity": "exact"})
    scenario.save(tmp_path / "s.toml")
    assert export(tmp_path / "a", str(tmp_path / "s.toml")) == 0
    assert export(tmp_path / "b", "ur5", "--limits", "none", "--gravity", "exact") == 0
    made, wanted = ((tmp_path / each / "controller.c").read_bytes() for each in "ab")
    assert made == wanted
    assert b"limits   none" in made


def test_what_a_robot_adds_by_itself_is_left_to_it(tmp_path):
    options = ("two_link", "--limits", "none", "--loop.dt", "0.002", "--gravity")
    for gravity in ("learn_residual", "learnt"):
        export(tmp_path / gravity, *options, gravity)
        test = (tmp_path / gravity / "selftest.c").read_text("utf-8")
        assert f"&r->target, {constant(0.002)}, &answer)" in test
    source = (tmp_path / "learn_residual" / "controller.c").read_text(encoding="utf-8")
    start = source.partition("_init(")[2].partition("return")[0]
    learnt, guard, _ = start.partition(constant(UNSEEN).strip("()"))
    firsts = learnt.partition("begun[] = {")[2].split(",")[:-1]
    assert firsts
    assert guard
    assert all(float(each) == 0.0 for each in firsts)


def test_a_tracking_law_that_learns_is_covered(tmp_path):
    assert (
        export(
            tmp_path,
            "two_link",
            "--controller.law",
            "tracking",
            "--controller.unknown",
            "tool",
            "--limits",
            "none",
        )
        == 0
    )
    assert "learnt kinematics" in (tmp_path / "controller.h").read_text("utf-8")


def test_what_is_not_covered_is_refused_with_the_reason(tmp_path, capsys):
    camera = (
        "--task.kind",
        "image",
        "--true.camera.kind",
        "pinhole",
        "--controller.law",
        "tracking",
        "--controller.unknown",
        "tool",
    )
    assert export(tmp_path / "none", "panda", *camera, "--limits", "none") == 2
    assert capsys.readouterr().err.startswith("approxjac: controller must take symbols")
    assert not (tmp_path / "none").exists()
