"""A joint that friction holds is no fault, and one that a command must move and stays is."""

import numpy as np
import pytest

import approxjac as aj
from approxjac.realtime import Accuracy, Fault
from approxjac.realtime.watches import FaultWatch

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
HELD = np.array([4.0, 4.0, 4.0, 4.0, 0.5, 0.5, 0.5])  # N m, of a few percent of the efforts


def watched(commands, q=lambda k: Q, reference=None, accuracy=None, velocity=False, gravity=False):
    """The fault of a panda at q (7,) of period k, under the commands (n, 7)."""
    panda, found = aj.load_robot("panda"), None
    accuracy = accuracy or Accuracy()
    most = panda.velocity_limits
    watch = FaultWatch(panda, 1e-3, accuracy, most, 0.02, velocity, gravity)
    for k, command in enumerate(commands):
        v = 1e3 * (q(k) - q(k - 1))
        found = found or watch.look(aj.Measurement(1e-3 * k, q(k), v, np.zeros(3)), 1e-3 * k)
        watch.commanded(command, reference)
    return found


@pytest.mark.parametrize("reference", [None, np.full(7, 0.01), np.full(7, 0.5)])
def test_a_joint_may_stand_still_under_a_torque(reference):
    """However far it is led: but not under one that friction cannot hold."""
    assert watched(np.tile(HELD, (300, 1)), reference=reference) is None
    rising = np.outer(np.linspace(0.0, 1.0, 300), 0.2 * np.array([87.0] * 4 + [12.0] * 3))
    assert watched(0.6 * rising, reference=reference) is None
    assert watched(rising, reference=reference) is Fault.COMMAND_UNANSWERED


@pytest.mark.parametrize("carried", [0.0, 20.0])
def test_by_default_it_may_stick_as_usual_joints_do(carried):
    """Pushed from one side of what usual friction holds to the other, beside what it carries."""
    usual = aj.robots.Friction.usual(aj.load_robot("panda"))
    most = usual.stribeck * usual.coulomb + usual.load * carried
    for share, fault in ((0.95, None), (1.4, Fault.COMMAND_UNANSWERED)):
        command = carried + np.outer(np.linspace(-share, share, 400), most)
        assert watched(command, gravity=True) is fault


def test_a_joint_that_is_sent_a_velocity_moves():
    assert watched(np.full((200, 7), 0.01), velocity=True) is None
    assert watched(np.full((200, 7), 0.5), velocity=True) is Fault.COMMAND_UNANSWERED


def test_a_joint_that_stands_is_held_against_gravity_as_others_move():
    """The arm sinks about its shoulder: by more than friction holds, at the standing elbow."""

    def q(k):
        return Q + 1e-3 * k * np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    dynamics = aj.robots.Dynamics(aj.load_robot("panda"))
    g = np.array([dynamics.g(q(k)) for k in range(1000)])
    accuracy = Accuracy(stiction=0.25 * np.abs(np.ptp(g, axis=0)) + 0.01)
    assert watched(g, q, accuracy=accuracy) is None
    assert watched(0.0 * g, q, accuracy=accuracy, gravity=True) is None
    for robot_adds in (False, True):  # what would be unanswered
        wrong = (2.0 - robot_adds) * g
        found = watched(wrong, q, accuracy=accuracy, gravity=robot_adds)
        assert found is Fault.COMMAND_UNANSWERED


def test_what_the_last_step_of_an_encoder_made_of_a_torque_is_no_push():
    """By damping times a filtered q̇ that fades; a torque that grows later is one."""
    accuracy = Accuracy(velocity_filter=0.01, stiction=1.0)
    fades = np.outer(-10.0 * np.exp(-np.arange(400) / 10.0), np.ones(7))
    gravity = aj.robots.Dynamics(aj.load_robot("panda")).g(Q)
    assert watched(fades + gravity, accuracy=accuracy) is None
    later = np.outer(3.0 * (np.arange(400) > 100), np.ones(7))
    assert watched(fades + later + gravity, accuracy=accuracy) is Fault.COMMAND_UNANSWERED


@pytest.mark.parametrize(("pushed", "fault"), [(0.0, None), (0.42, Fault.COMMAND_UNANSWERED)])
def test_torque_for_the_motion_of_others_is_answered_and_hides_no_joint_that_is_dead(pushed, fault):
    """The shoulder swings, and the elbow needs torque to stand meanwhile; a wrist is pushed."""
    dynamics, omega = aj.robots.Dynamics(aj.load_robot("panda")), 2.0 * np.pi
    shoulder, wrist = np.eye(7)[1], np.eye(7)[6]

    def q(k):
        return Q + 0.03 * (1e-3 * omega * k - np.sin(1e-3 * omega * k)) * shoulder

    commands = []
    for k in range(420):
        v = 0.03 * omega * (1.0 - np.cos(1e-3 * omega * k)) * shoulder
        a = 0.03 * omega**2 * np.sin(1e-3 * omega * k) * shoulder
        inverse = dynamics.inverse(q(k), v, a)
        commands.append(inverse + pushed * min(4e-3 * k, 1.0) * wrist)
    coupling = np.abs([each[3] - dynamics.g(q(k))[3] for k, each in enumerate(commands)])
    accuracy = Accuracy(q=1e-5, stiction=0.2)
    assert np.ptp(coupling) > 2.0 * 2.0 * 0.2
    assert watched(commands, q, accuracy=accuracy) is fault
