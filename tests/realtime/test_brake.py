"""`Watchdog`: what it does at the moment at which the loop ends by itself."""

import signal
import time

import numpy as np
import pytest

from approxjac.realtime.brake import Brake, HungError, Watchdog


class Slow:
    """A robot that takes its time to brake."""

    def brake(self):
        time.sleep(0.1)


def test_no_alarm_comes_after_the_loop(request):
    strays = []
    before = signal.signal(signal.SIGALRM, lambda *_: strays.append(1))
    request.addfinalizer(lambda: signal.signal(signal.SIGALRM, before))
    watchdog = Watchdog(Brake(Slow()), 0.02)
    with watchdog:
        while not watchdog.bit:  # it brakes now, and means to interrupt what hangs
            time.sleep(1e-3)
    time.sleep(0.2)
    assert not strays  # a user has no handler: this would have ended the process


class Robot:
    def __init__(self):
        self.sent = []

    def send(self, command):
        self.sent.append(command)

    def brake(self):
        pass


def test_a_command_after_the_brake_ends_the_loop():
    """It is not sent, and whoever sends it may not go on as if it had been."""
    robot = Robot()
    brake = Brake(robot)
    brake.send(np.zeros(2))
    brake.close()
    with pytest.raises(HungError):
        brake.send(np.ones(2))
    assert len(robot.sent) == 1
