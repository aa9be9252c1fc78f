"""What a user typed: how it is read, and what is said of it where it cannot be."""

import pytest

from approxjac.cli import main

TEXTS = """
simulat panda
command 'simulat' not in approxjac; did you mean 'simulate'?

--bogus
option '--bogus' not in approxjac; valid are --help, --version, export, paper, robots, simulate, \
stability, view

simulate
simulate needs one robot (a name that approxjac robots lists, a .urdf file, or a .toml file with a \
scenario), got none

simulate panda ur5
simulate takes one robot (a name that approxjac robots lists, a .urdf file, or a .toml file with a \
scenario), got panda ur5

simulate pando
robot 'pando' not in the robots known by name; did you mean 'panda'?

simulate panda --learn-kinematic
option '--learn-kinematic' not in simulate --help-all; did you mean \
'--learn-kinematics'?

simulate panda --objct-length 1
option '--objct-length' not in simulate --help-all; did you mean '--object-length' or \
'--stability.object-length' or '--believed-length'?

simulate panda --object-length
--object-length takes a number, got nothing (length of the object, from the arm's tip to its own, m)

simulate panda --object-length long
--object-length takes a number, got long (length of the object, from the arm's tip to its own, m)

simulate panda --object-length nan
--object-length must be a finite number >= 0, got nan

simulate panda --object-length 15
--object-length must be at most 10 [m], got 15; 200 mm are 0.2

simulate panda --believed.object.radius 15
--believed.object.radius must be at most 10 [m], got 15; 200 mm are 0.2

stability panda --object-length 0 20
--object-length must be at most 10 [m], got 20; 200 mm are 0.2

stability panda --object-mass 0 1e300
--object-mass must be at most 10000 [kg], got 1e+300; 500 g are 0.5

stability panda --object-length 0 1 --believed-length 15
--believed-length must be at most 10 [m], got 15; 200 mm are 0.2

stability panda --object-length 0.12 0.18
--object-length must contain what is believed, 0 [m], got 0.12 0.18; 0.0 0.18 does; or believe \
the middle, --believed-length 0.15

stability panda --object-mass 1 2
--object-mass must contain what is believed, 0 [kg], got 1.0 2.0; 0.0 2.0 does; or believe the \
middle, --believed-mass 1.5

simulate panda --believed-length -0.1
--believed-length must be a finite number >= 0, got -0.1

simulate panda --believed.object.length -0.1
--believed.object.length must be a finite number >= 0, got -0.1

simulate panda --believed-length=-0.1
--believed-length must be a finite number >= 0, got -0.1

simulate panda --kp 0
--kp must be a finite number > 0, got 0.0

simulate panda --kp 1 2
--kp must be 3 numbers, got 2

simulate panda --kv 400 a
--kv takes numbers, got 400 a (gain K_v of velocity, one number or one a task coordinate; by the \
rule if not given)

simulate panda --damping -1
--damping must be a finite number >= 0, got -1.0

simulate panda --gravity lernt
--gravity takes learnt, exact, believed, none or rest, got lernt (compensated as it is learnt (law \
(28)), as it truly is ("exact"), as the believed arm has it, or not at all; or the "rest" is \
learnt from 0, of a robot that adds the gravity of the believed arm by itself (Franka, UR))

simulate panda --start 0 0
--start must be 7 numbers [rad or m], got 2

simulate panda --start 0 -30 0 -120 0 90 45
--start must be in radians: it is 116.9 rad beyond the limits of panda_joint4, as degrees would be

simulate panda --start 0 -0.5 0 -9 0 1.6 0.7
--start must be within the joint limits, got -9 for panda_joint4 (-3.072 to -0.0698 rad)

simulate panda --target 0.4 0.1
--target must be 3 numbers [m], got 2

simulate panda --target 0.4 0 0.4 --target-offset 0.1 0 0
--target and --target-offset must not both be given, as there is one target

simulate panda --duration 1e-9
--duration must be a finite number >= --loop.dt = 0.001 [s], got 1e-09

simulate panda --seed 1.5
--seed takes a whole number, got 1.5 (seed of target, noise and dropouts, and of a random start)

simulate panda --limits -1
--limits must be a finite number > 0, got -1.0

simulate panda --object-axis q
--object-axis: axis 'q' not in the axes; valid are -x, -y, -z, x, y, z

simulate panda --object-axis 1,2
--object-axis must be a list of 3 numbers or a word, got 1.0 2.0

simulate panda --path oval
--path takes circle, line or waypoints, and then the circle's radius, the line's offset or the \
points, in m; got oval

simulate panda --path circle
--path circle takes a number, got nothing (in m; no circle by default)

simulate panda --path circle -1
--path circle must be a finite number > 0, got -1.0

simulate panda --believed.shifts panda_joint9 0 0 1
--believed.shifts: joint 'panda_joint9' not in panda; did you mean 'panda_joint8' or \
'panda_joint7' or 'panda_joint6'?

simulate panda --believed.shifts panda_joint4 0 0
--believed.shifts takes a joint and 3 numbers, for one joint or several, got panda_joint4 0 0 \
(errors of the believed joint origins, m, such as panda_joint4 0 0.01 0)

simulate panda --speed 2
--speed is for a run that is shown with --view, got 2 without

simulate panda --view=yes
--view takes no value, got yes (show the run in the browser while it goes on; there the target and \
the believed length can be changed, and the run paused or stopped)

simulate panda --true.floor 0
--true.floor needs --true.engine mujoco, got 0.0 with pinocchio

simulate panda --task.kind image --task.points 9
--task.points must be 1, 2 or 3, got 9; four, such as a tag's corners, are for Python: \
approxjac.tasks.CombinedTask.balanced

simulate panda --sensor.rate 1e6
--sensor.rate must be at most that of control, 1000 [Hz], got 1e+06

simulate panda --learn-kinematics --gravity exact
--gravity must be learnt or believed with law T (--learn-kinematics), got exact

simulate panda --no-limits --controller.torque-rate 9
--controller.torque-rate needs --no-limits, "urdf" or a share of the URDF's such as 0.5, got 9.0 \
with none

simulate panda --save nowhere/s.toml
--save must be a file in a folder that there is, got nowhere/s.toml

simulate panda --out file
--out must be a folder that can be made, got file: File exists

simulate zero.toml
controller.kp must be a finite number > 0, got 0.0 in zero.toml

simulate late.toml
sensor.delay must be shorter than the run, 20 [s], got 100

simulate late.toml --sensor.delay 30
--sensor.delay must be shorter than the run, 20 [s], got 30

stability panda --object-length 0.3
--object-length takes 2 numbers, got 0.3 (smallest and largest true length of the object, m)

stability panda --object-length 0.3 0.1
--object-length must be (smallest, largest) [m], got 0.3 0.1; 0.1 0.3 is such a range

stability panda --object-length 0 0.1 --around 0 0
--around must be 7 numbers [rad or m], got 2

stability panda --object-length 0 0.1 --reach-from 0 0 0 0 0 0 0
--reach-from needs --target, got none

stability panda --object-length 0 0.1 --map error b
--map: parameter 'b' not in the map; valid are a, damping, error, kv

stability panda --learn-kinematics
--learn-kinematics must be left out of a report, which is about a fixed Jacobian, got tool origins \
camera

stability panda --roll 0 1
--roll needs --task.kind image, got position

stability panda --jobs 0
--jobs must be >= 1, got 0

paper --figures 2
--figures must be among 1, 3, 4, 5, 6, 7, 8, got 2

paper --inertia ring
--inertia takes rod or point-mass, got ring (uniform rods, or point masses at their middles)

paper --duration -1
--duration must be a finite number > 0 [s], got -1.0

robots panda --tip panda_hnad
--tip: frame 'panda_hnad' not in panda; did you mean 'panda_hand' or 'panda_hand_tcp' or \
'panda_link8'?

robots --tip tool0
--tip, --base and --free need a robot, got none

view
view needs one run (a run.npz that simulate, paper or Trajectory.save wrote, or its folder), got \
none

view x.npz
x.npz is not a trajectory written by Trajectory.save: it is no .npz file

view file --out nowhere/page.html
--out must be a file in a folder that there is, got nowhere/page.html

export panda --gravity none --effort-only --folder file
--folder must be one that can be made, got file: File exists
"""
CASES = [case.split("\n") for case in TEXTS.strip().split("\n\n")]


@pytest.mark.parametrize(("words", "told"), CASES, ids=[case[0] for case in CASES])
def test_what_is_typed_wrong_is_told_in_one_line(words, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files = {
        "file": "hi", "x.npz": "hi", "zero.toml": 'robot = "panda"\n[controller]\nkp = 0\n',
        "late.toml": 'robot = "panda"\n[sensor]\ndelay = 100\n',
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert main(words.split()) == 2
    assert capsys.readouterr().err == f"approxjac: {told}\n"
