"""`Watchdog`: what it does at the moment at which the loop ends by itself."""

import signal
import time

from approxjac.realtime.brake import Brake, Watchdog


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
