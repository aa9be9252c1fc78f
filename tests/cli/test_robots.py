"""`approxjac robots`: the list of arms, and one of them joint by joint."""

import pytest

import approxjac as aj
from approxjac.cli import main
from approxjac.robots.load import NAMED, urdf_path


def test_robots_lists_every_arm(capsys):
    assert main(["robots"]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[0].split() == [
        "name", "nv", "nq", "joints", "suggested", "tip", "kg",
    ]  # fmt: skip
    assert [line.split()[0] for line in lines[2:]] == list(aj.robots.robot_names())
    words = {line.split()[0]: " ".join(line.split()) for line in lines[2:]}
    assert words["panda"] == "panda 7 7 7 revolute panda_hand_tcp 16.8"
    assert words["kinova"].startswith("kinova 6 9 3 continuous, 3 revolute j2s6s200_end_")
    assert words["tiago_arm"].startswith("tiago_arm 8 8 1 prismatic, 7 revolute wrist_")
    assert words["double_pendulum"] == "double_pendulum 2 2 2 revolute link3 0.5"


def test_robots_describes_one(capsys):
    assert main(["robots", "tiago_arm"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("tiago_arm: 1 prismatic, 7 revolute; nv 8, nq 8; 18.21 kg\n")
    words = [" ".join(line.split()) for line in out.splitlines()]
    assert "tip: wrist_ft_tool_link" in words
    assert "torso_lift_joint prismatic 0 to 0.35 m 2000 N" in words
    assert "arm_1_joint revolute 0 to 2.749 rad 39 N m" in words
    assert "locked: wheel_right_joint, wheel_left_joint, head_1_joint, head_2_joint" in words
    main(["robots", "panda", "--free", "panda_finger_joint1"])
    out = capsys.readouterr().out
    assert "panda_finger_joint1  prismatic  0 to 0.04 m            100 N" in out
    assert "moving with another joint: panda_finger_joint2" in out
    assert "locked" not in out
    main(["robots", "panda", "--free", "all"])
    assert "nv 8, nq 8" in capsys.readouterr().out
    main(["robots", "kinova"])
    assert "j2s6s200_joint_1  continuous  none                 40 N m" in capsys.readouterr().out
    main(["robots", "double_pendulum"])
    assert "joint1  revolute  none known  none known" in capsys.readouterr().out
    main(["robots", "talos_arm"])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_robots_takes_any_urdf(capsys):
    path = str(urdf_path(NAMED["baxter_left_arm"]))
    assert main(["robots", path]) == 0
    out = capsys.readouterr().out
    assert "nv 17, nq 17" in out
    assert "tip: not clear, as it has more than one end: name one as tip (--tip)" in out
    assert "likely tips are left_gripper, right_gripper, " in " ".join(out.split())
    assert main(["robots", path, "--tip", "right_gripper"]) == 0
    by_path = capsys.readouterr().out.splitlines()
    assert main(["robots", "baxter_left_arm", "--tip", "right_gripper"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == by_path[1:]
    assert main(["robots", "talos_arm", "--base", "base_link"]) == 0
    assert "9 revolute" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["pnada"], "approxjac: robot 'pnada' not in the robots known by name; did you mean 'pan"),
        (["nowhere.urdf"], "approxjac: URDF file nowhere.urdf does not exist"),
        (
            ["panda", "--free", "thumb"],
            "approxjac: --free: moving joint 'thumb' not in panda; valid are ",
        ),
        (["panda", "--tip", "hand"], "approxjac: --tip: frame 'hand' not in panda; did you mean"),
        (["--tip", "hand"], "approxjac: --tip, --base and --free need a robot, got none"),
    ],
)
def test_a_robot_that_does_not_load_gives_exit_code_2(capsys, arguments, text):
    assert main(["robots", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(text)
    assert captured.err.count("\n") == 1
    assert captured.out == ""
