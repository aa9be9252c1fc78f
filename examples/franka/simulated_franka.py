"""`SimulatedFranka`: an FR3 to try a loop on, over the network protocol of the real one."""

import contextlib
import importlib.util
import os
import random
import socket
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import approxjac as aj

SERVER = Path(__file__).parent / "server.py"
PYTHON = "APPROXJAC_FRANKA_SIM"  # the variable with the Python that runs the server
PORT = 1337  # the only one that libfranka calls


def missing():
    """Return what is missing to run the simulated robot and to talk to it, or nothing."""
    if importlib.util.find_spec("pylibfranka") is None:
        return "pylibfranka is not installed: pip install 'approxjac[franka]'"
    if not os.environ.get(PYTHON):
        return f"{PYTHON} is not set: see examples/franka/make_environment"
    return ""


class SimulatedFranka:
    """An FR3 that holds a tool it was not told of, in a process of its own; a context.

    Args:
        length, mass: Of the tool, across the flange [m], [kg].
        friction: Coulomb's, of each joint [N m].

    Attributes:
        address: Where it listens; only on this machine.
        arm: The robot as its URDF has it.
        truth: The robot with its tool, for sensors and for judges.
    """

    def __init__(self, length=0.2, mass=0.5, friction=0.2):
        urdf = subprocess.check_output([os.environ[PYTHON], SERVER, "--where"], text=True).strip()
        self.arm = aj.load_robot(urdf, tip="link8")
        self.truth = self.arm.with_object(length, mass, axis="x")
        self.address, self._friction = free_address(), friction

    def __enter__(self):
        with contextlib.ExitStack() as opened:
            folder = opened.enter_context(tempfile.TemporaryDirectory())
            urdf = self.truth.save_urdf(Path(folder, "arm.urdf"))
            said = opened.enter_context(open(Path(folder, "said.txt"), "w+", encoding="utf-8"))
            command = [os.environ[PYTHON], SERVER, urdf, "--host", self.address]
            process = subprocess.Popen(
                [*command, "--friction", str(self._friction)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True,
            )  # fmt: skip
            opened.callback(process.wait)
            opened.enter_context(process.stdout)
            opened.enter_context(process.stdin)  # whose end ends it
            if process.stdout.readline() != "ready\n":
                said.seek(0)
                raise RuntimeError(f"the simulated Franka did not start: {said.read()}")
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *_):
        self._opened.close()


class Camera:
    """The tip as it is seen: at once and exactly, or as a camera sees it.

    Args:
        robot: The true one.
        noise: Standard deviation [m].
        rate: Frames a second; None for one whenever it is asked.
        late: Age of a frame when it arrives [s].
        seed: Of the noise.
    """

    def __init__(self, robot, noise=0.0, rate=None, late=0.0, seed=0):
        self.task = aj.PositionTask(robot)
        self._noise, self._late = noise, late
        self._period = 0.0 if rate is None else 1.0 / rate
        self._random = np.random.default_rng(seed)
        self._next, self._under_way, self._last = None, [], None

    def __call__(self, t, q):
        """Return the last x that has arrived at t [s], and when it was taken."""
        if self._next is None or t >= self._next:
            x = self.task.value(q) + self._noise * self._random.standard_normal(3)
            self._under_way.append((x, t))
            self._last = self._last or (x, t)  # there was one before it was asked
            self._next = (t if self._next is None else self._next) + self._period
        while self._under_way and t - self._under_way[0][1] >= self._late:
            self._last = self._under_way.pop(0)
        return self._last


def free_address():
    """Return an address of this machine at which nobody serves a Franka yet."""
    while True:
        address = f"127.{random.randint(1, 254)}.{random.randint(1, 254)}.1"
        with socket.socket() as tried, contextlib.suppress(OSError):
            tried.bind((address, PORT))
            return address
