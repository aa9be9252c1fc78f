"""Mistakes that one makes: each error says what was expected, what was given, what is valid."""

import numpy as np
import pytest

import approxjac as aj

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
ARM, UR = aj.load_robot("panda"), aj.load_robot("ur5")
TRUTH, BELIEF = ARM.with_object(0.2, 0.5, axis="x"), ARM.with_object(0.0)
PLANT, TASK = aj.Plant(TRUTH), aj.PositionTask(BELIEF)
LAW = aj.SetpointController(TASK, aj.Gains(400.0, 80.0, 1.0))
X = PLANT.sensor.value(Q)
SEEN = aj.Measurement(0.0, Q, np.zeros(7), X)
NONE = np.zeros(0)

MISTAKES = {
    "a frame of another robot": (
        lambda: aj.PositionTask(BELIEF, "tcp"),
        "frame 'tcp' not in panda; did you mean 'panda_hand_tcp'?",
    ),
    "a list in the control loop": (
        lambda: LAW.evaluate(NONE, SEEN._replace(q=list(Q)), X),
        r"q must be an array of shape \(7,\) .* got list; numpy.array\(q, dtype=float\) makes one",
    ),
    "a list as target in the loop": (
        lambda: LAW.evaluate(NONE, SEEN, list(X)),
        r"target must be an array of shape \(3,\) .* got list; numpy.array\(target, dtype=float\)",
    ),
    "a start with a joint too few": (
        lambda: aj.simulate(PLANT, LAW, X, Q[:6]),
        r"q0 must have shape \(7,\) \[rad or m\], got shape \(6,\)",
    ),
    "a start in degrees": (
        lambda: aj.simulate(PLANT, LAW, X, np.degrees(Q)),
        r"q0 must be in radians: it is .* rad beyond the limits of panda_joint4; numpy.radians",
    ),
    "a matrix of gains": (
        lambda: aj.Gains(np.eye(3), 80.0),
        r"kp must be a number or the diagonal of a matrix, .*, got shape \(3, 3\)",
    ),
    "negative gains": (lambda: aj.Gains(-400.0, 80.0), r"kp must be > 0 in every entry, got \[-4"),
    "no damping of the self-motion": (
        lambda: aj.SetpointController(TASK, aj.Gains(400.0, 80.0)),
        r"damping must be > 0 .* 7 joints for 3 task coordinates, and nothing else damps its self",
    ),
    "a pose without a sensor of poses": (
        lambda: aj.simulate(PLANT, aj.SetpointController(aj.PoseTask(BELIEF)), X, Q),
        r"got PoseTask\('panda', 'object_tip'\); Plant\(robot, sensor=...\) takes such a task of t",
    ),
    "a sensor of the believed robot": (
        lambda: aj.Plant(TRUTH, TASK),
        r"sensor must be a task of the plant's own robot, the true one, .* \(the believed one\?\)",
    ),
    "plant and controller the wrong way round": (
        lambda: aj.simulate(LAW, PLANT, X),
        r"plant must be a Plant \(the first argument; the controller is the second\), got Setpoint",
    ),
    "a target of another length": (
        lambda: aj.simulate(PLANT, LAW, X[:2]),
        r"target must have shape \(3,\) \[m\], got shape \(2,\)",
    ),
    "no target": (
        lambda: aj.simulate(PLANT, LAW, None),
        r"target must be numbers of shape \(3,\) \[m\], got None",
    ),
    "a file that is not there": (
        lambda: aj.load_robot("my.urdf"),
        "URDF file my.urdf does not exi",
    ),
    "a name with a capital": (lambda: aj.load_robot("Panda"), "did you mean 'panda'?"),
    "a controller of another arm": (
        lambda: aj.simulate(PLANT, aj.SetpointController(aj.PositionTask(UR)), X, Q),
        "the controller's robot must have the 7 joints of the plant's, panda, got ur5 with 6",
    ),
    "steps that are too long": (
        lambda: aj.simulate(
            PLANT, aj.SetpointController(TASK, aj.Gains(4e3, 800.0, 10.0)), X, Q, 2.0, dt=0.05
        ),
        r"the simulation diverged at t = .* \(a smaller dt or smaller gains may help\)",
    ),
    "an axis that is none": (
        lambda: aj.PositionTask(BELIEF, axes="xyw"),
        "axis 'w' not in axes; v",
    ),
    "a robot for a task": (
        lambda: aj.SetpointController(BELIEF),
        r"task must be a task of the believed robot, such as PositionTask\(robot\), got Robot\(",
    ),
    "the sensor for the controller": (
        lambda: aj.simulate(PLANT, PLANT.sensor, X),
        r"controller must be a controller, such as SetpointController\(...\), got PositionTask\(",
    ),
    "gravity in words": (
        lambda: aj.SetpointController(TASK, gravity="learnt"),
        r"gravity must be one of .*, such as AdaptiveGravity\(belief\), got 'learnt'",
    ),
    "a length with its unit": (
        lambda: ARM.with_object("20cm"),
        r"length must be a finite number >= 0 \[m\], got '20cm'",
    ),
    "a second object of the same name": (
        lambda: TRUTH.with_object(0.1),
        "name must be new to the robot, got 'object': panda already has a frame 'object', perh",
    ),
    "one number for a range": (
        lambda: aj.Uncertainty(ARM, object_length=0.2),
        r"object_length must be \(smallest, largest\) \[m\], such as \(0.0, 0.2\), got 0.2",
    ),
    "a number for limits": (
        lambda: aj.TorqueLimited(LAW, 87.0),
        r"limits must be Limits\(effort=...\), Limits.of\(robot\) or None, got 87.0",
    ),
    "joints that are not known": (
        lambda: LAW.evaluate(NONE, SEEN._replace(q=np.full(7, np.nan)), X),
        "q must be finite, .*: no safe torque exists without the joint state; stop the robot",
    ),
    "a whole-numbered target": (
        lambda: LAW.evaluate(NONE, SEEN, np.array([1, 0, 1])),
        r"target must be an array of float64, got int64; target.astype\(float\) makes one",
    ),
    "rates of limits without their step": (
        lambda: aj.rollouts(
            aj.TorqueLimited(LAW, aj.Limits(effort=80.0, rate=1e3), dt=2e-3),
            aj.Uncertainty(ARM),
            aj.JointBox(ARM),
        ),
        r"dt must be that of the controller, 0.002 \[s\], .* got 0.001",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_error_teaches(mistake):
    make, text = MISTAKES[mistake]
    with pytest.raises(aj.ApproxJacError, match=text) as caught:
        make()
    assert "object at 0x" not in str(caught.value)
    assert len(str(caught.value)) < 450
