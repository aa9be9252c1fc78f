"""Time of a simulated second with a live view, as a ratio to the same without one.

The view runs as fast as the simulation goes, with nobody who looks; 30 instants of each second of
the clock are sent. Both run in turn in one process.

    python tests/benchmarks/live_view.py
"""

import time

import numpy as np

import approxjac as aj
from approxjac import view

ROUNDS = 5
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def main():
    arm = aj.load_robot("panda")
    truth, belief = arm.with_object(0.2, 0.5, axis="x"), arm.with_object(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    controller = aj.SetpointController(
        aj.PositionTask(belief), gravity=aj.controllers.ModelGravity(truth)
    )
    target = plant.sensor.value(START) + [0.1, -0.15, 0.16]

    def simulated(observer=None):
        began = time.perf_counter()
        aj.simulate(
            plant, controller, target, START, 5.0, dt=1e-3, record_every=0.1, observer=observer
        )
        return time.perf_counter() - began

    class Timed:
        """A view that tells when the first step was over: starting the page is not a step."""

        def __init__(self):
            self.live = view.LiveView(speed=float("inf"), patience=0.0)
            self.began = None

        def __call__(self, loop):
            self.live(loop)
            if self.began is None:
                self.began = time.perf_counter()

    alone, shown = [], []
    for _ in range(ROUNDS):
        alone.append(simulated(lambda loop: None))
        timed = Timed()
        simulated(timed)
        shown.append(time.perf_counter() - timed.began)
    ratio = np.median(shown) / np.median(alone)
    print(f"5 simulated seconds at 1 kHz: {np.median(alone):.2f} s, with a view ", end="")
    print(f"{np.median(shown):.2f} s, ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
