"""Send signals to a program that controls a robot, at random instants, and see that it brakes.

A child process runs `aj.control` again and again, behind `SimulatedDriver` in real time; SIGINT,
SIGTERM, SIGHUP and SIGQUIT are sent to it at instants drawn from its start to mid-motion. Counted
are runs that came to rest with the brake closed.

    python examples/studies/signals.py --out results/signals

Exit code 1 means that an arm was left without its brake.
"""

import os
import signal
import subprocess
import sys
import time

import numpy as np
from common import head, parser, row, write

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
LATEST = 0.8  # s after the call of `control`


def child():
    """Control an arm whenever a line comes in; tell how it ended."""
    import approxjac as aj
    from approxjac.realtime import SimulatedDriver, Tolerances

    panda = aj.load_robot("panda")
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    plant = aj.Plant(truth, aj.PositionTask(truth))
    law = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
    controller = aj.TorqueLimited(law, aj.Limits.of(belief))
    start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    goal = plant.sensor.value(start) + [0.10, -0.15, 0.16]
    asked = []

    class Driver(SimulatedDriver):
        """One that says when it is first read."""

        def read(self):
            """Return a measurement."""
            if not asked:
                asked.append(print("begun", flush=True))
            return super().read()

    print("ready", flush=True)
    for _ in sys.stdin:
        asked.clear()
        driver = Driver(plant, start)
        run = aj.control(driver, controller, goal, 3.0, tolerances=Tolerances(max_period=5.0))
        speed = float(np.abs(driver.v).max())
        print(f"{run.ended}|{driver.braked}|{speed}|{run.t[-1]}", flush=True)


def main(arguments=None):
    """Send all signals, write the table, and return the exit code."""
    options = parser(__doc__, "results/signals")
    options.add_argument("--times", type=int, default=50, help="each signal is sent")
    args = options.parse_args(arguments)
    times, rng = 2 if args.quick else args.times, np.random.default_rng(0)
    program = [sys.executable, os.path.abspath(__file__), "child"]
    lines, failed = head("signal", "sent", "braked", "rad/s at the brake, at most"), 0
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        for name in NAMES:
            braked, fastest = 0, 0.0
            for _ in range(times):
                process.stdin.write("go\n")
                process.stdin.flush()
                assert process.stdout.readline() == "begun\n"
                time.sleep(rng.uniform(0.0, LATEST))
                process.send_signal(getattr(signal, name))
                ended, is_braked, speed, _ = process.stdout.readline().strip().split("|")
                braked += is_braked == "True" and ended == f"{name}: brought to rest"
                fastest = max(fastest, float(speed))
            failed += times - braked
            lines.append(row(name, times, braked, f"{fastest:.2g}"))
        process.stdin.close()
    write(args.out, {"signals.md": "\n".join(lines) + "\n"}, {"failed": failed})
    return 1 if failed else 0


if __name__ == "__main__":
    child() if sys.argv[1:] == ["child"] else sys.exit(main())
