"""`approxjac learn`, from files as a robot's owner has them."""

import json
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.calibration.test_calibrate import elsewhere, sockets
from tests.controllers.test_learnt_axes import Arm

import approxjac as aj
from approxjac.cli.main import main
from approxjac.robots import KinematicBelief
from approxjac.scenario.build import build_scenario, recommended
from approxjac.tasks import PositionTask


@pytest.fixture(scope="module")
def arm():
    return Arm("panda", 81)


@pytest.fixture(scope="module")
def files(arm, tmp_path_factory):
    """Two places with two sockets each, with and without names of joints."""
    folder, paths = tmp_path_factory.mktemp("recorded"), []
    for i, each in enumerate(sockets(arm, 9, places=2)[0]):
        path = folder / each.place[0] / f"hole_{i % 2}.csv"
        path.parent.mkdir(exist_ok=True)
        head = ",".join(arm.believed.joint_names) + "\n" if i < 2 else ""
        path.write_text(head + "\n".join(",".join(map(repr, row.tolist())) for row in each.q))
        paths.append(str(path))
    return paths


def test_files_become_an_arm(arm, files, tmp_path, capsys):
    out = tmp_path / "as it is"
    assert (
        main(["learn", "panda", *files, "--kind", "socket", "--apart", "0.05", "--out", str(out)])
        == 0
    )
    said = capsys.readouterr().out
    assert (out / "report.txt").read_text() in said
    assert "are left where it was not fitted" in said
    robot = aj.load_robot(out / "arm.urdf", tip="panda_hand_tcp")
    assert elsewhere(arm, robot) < 0.6e-3
    left = np.genfromtxt(out / "residuals.csv", delimiter=",", skip_header=1, usecols=1)
    assert left.shape == (120,)
    assert np.median(left) < 0.3e-3
    scenario = aj.Scenario.load(out / "scenario.toml")
    assert scenario.robot == str(out / "arm.urdf")
    assert scenario.true.calibration == str(out / "calibration.npz")
    known = KinematicBelief.load(scenario.true.calibration)
    assert known.covariance.shape == (len(known.names),) * 2
    # each run is of an arm by that covariance, as its seed says
    belief, tips = PositionTask(robot), []
    for seed in (0, 0, 1):
        built = build_scenario(scenario.with_values({"run": {"seed": seed}}))
        q = built.plant.robot.neutral()
        tips.append(built.plant.sensor.value(q))
        assert_allclose(built.law.task.value(q), belief.value(q), atol=1e-9)
    assert_array_equal(tips[0], tips[1])
    # and the law that learns begins with what is known of the joints, and a new tool
    learns = build_scenario(recommended(scenario)).law.kinematics
    state = learns.initial_state(built.plant.measure(0.0, q, np.zeros(7))._replace(t_x=0.0))
    rows = {row.name: row for row in learns.report(state).rows}
    for i, name in enumerate(known.names):
        sd = 0.2 if name.startswith("tool") else np.sqrt(known.covariance[i, i])
        assert rows[name].sd == pytest.approx(sd, rel=0.1)
    off = np.linalg.norm([tips[0] - tips[2], tips[0] - belief.value(q)], axis=1)
    assert ((off > 1e-5) & (off < 0.05)).all()
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] in said
    assert report["coverage"] in said
    assert [each["name"] for each in report["numbers"]] == [*known.names]
    assert [each["learnt"] for each in report["numbers"]] == known.learnt.tolist()
    assert [each["place"] for each in report["places"]] == ["place 0", "place 1"]
    assert report["tip_sd"][0] < report["tip_sd"][2] < 5e-3
    assert report["verdict"] in (out / "report.html").read_text()
    assert str(out / "report.html") in said


@pytest.mark.study
def test_the_arm_is_judged_with_its_covariance(files, tmp_path, capsys, monkeypatch):
    """From the recordings to the report, and from any folder."""
    out = tmp_path / "as it is"
    assert main(["learn", "panda", *files, "--apart", "0.05", "--out", str(out)]) == 0
    monkeypatch.chdir(out)
    capsys.readouterr()
    options = ["--configurations", "40", "--runs", "0", "--map-points", "0"]
    around = [
        "--around",
        *["0", "-0.5", "0", "-2", "0", "1.6", "0.7"],
        "--controller.gravity",
        "exact",
    ]
    main(["stability", "scenario.toml", *options, *around, "--out", "judged"])
    said = capsys.readouterr()
    assert "errors   45 learnt numbers up to 7.85 sd off" in said.out, said.err
    assert "near targets  stable" in said.out
    known = KinematicBelief.load("calibration.npz")
    errors = aj.Uncertainty(aj.load_robot("arm.urdf", tip="panda_hand_tcp"), covariance=known)
    assert errors.d == 45


def test_without_matplotlib_there_is_no_page_but_all_else(files, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(aj, "view", aj.view)  # which is imported anew meanwhile
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for name in [name for name in sys.modules if name.startswith("approxjac.view")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["learn", "panda", files[0], "--out", str(tmp_path)]) == 0
    assert "No report.html: " in (said := capsys.readouterr().out)
    assert "pip install 'approxjac[study]'" in said
    assert not (tmp_path / "report.html").exists()
    assert (tmp_path / "report.json").is_file()


def test_one_place_is_not_enough_to_say_how_far_it_holds(files, tmp_path, capsys):
    assert main(["learn", "panda", files[0], "--out", str(tmp_path)]) == 0  # each fifth is left out
    assert "place 0 5/5" in capsys.readouterr().out


def test_what_learn_cannot_use_is_told(files, tmp_path, capsys):
    for words, told in (
        ([], "needs files after the robot, got none"),
        (["none.csv"], "none.csv cannot be read"),
        ([files[0], "--apart", "0.05"], "--apart needs two sockets at a place, place 0 has 1"),
        ([files[0], "--kind", "pose"], "--kind must be one that the files have, socket at most"),
        ([files[0], "--unknown", "camera"], "--unknown must be one or more of tool, origins, axes"),
    ):
        assert main(["learn", "panda", *words, "--out", str(tmp_path)]) == 2
        assert told in capsys.readouterr().err
