"""Steps of the closed loop a second in lanes with real sensors and late motors, on one core.

The loop of `lanes.py`, of a second; what is drawn, and the generators that draw it, are included.

    OMP_NUM_THREADS=1 python tests/benchmarks/sensing.py
"""

import lanes
import turns

from approxjac.codegen.lanes import Lanes
from approxjac.simulation import Sensing

STEPS, ROUNDS = 1000, 5
FRAMES = {"x_rate": 60.0, "x_delay": 0.03, "x_dropout": 0.1}
ROUGH = Sensing(x_noise=1e-3, q_noise=1e-5, q_quantum=1e-5, velocity_filter=5e-3, **FRAMES)
LOOPS = {
    "ideal": {},
    "torques 4 ms late": {"actuator_delay": 4e-3},
    "x 30 ms late at 60 Hz, q̇ from differences": {
        "sensing": Sensing(x_rate=60.0, x_delay=0.03, velocity_filter=5e-3)
    },
    "that x with noise and dropouts": {"sensing": Sensing(x_noise=1e-3, **FRAMES)},
    "noise on q and x at 1 kHz": {"sensing": Sensing(x_noise=1e-3, q_noise=1e-5)},
    "all of it": {"sensing": ROUGH, "actuator_delay": 4e-3},
    "all of it, learnt gravity": {"sensing": ROUGH, "actuator_delay": 4e-3, "learns": True},
}


def in_lanes(learns=False, **late):
    """A function that takes all steps of all runs."""
    law, first, begun, box = lanes.study(learns, **late)
    loop = Lanes(law, first.plant, begun, box, lanes.DT, STEPS, 1e-3)
    return lambda: loop.run(begun, 10)


def table():
    """Markdown."""
    runs = {name: in_lanes(**options) for name, options in LOOPS.items()}
    taken = turns.medians(runs, [()] * 2, ROUNDS)
    steps = lanes.LANES * (STEPS + 1)
    rows = [(name, 1e-6 * steps / each, 1e9 * each / steps) for name, each in taken.items()]
    return turns.table(("on one core", "10⁶ steps/s", "ns"), rows)


if __name__ == "__main__":
    print(table())
