"""The sampled closed loop on symbols: plant and law."""

import hashlib
import io
import pickle
import sys
import uuid
from collections.abc import Mapping
from types import FunctionType
from typing import Any

import numpy as np

from approxjac import law
from approxjac.codegen import traced_law as laws
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.sensors import TracedSensing
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import (
    LARGEST_ANGLE,
    Condition,
    Scalar,
    Symbols,
    select,
    symbols,
)
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Measurement, Target
from approxjac.simulation import Plant
from approxjac.simulation.plant import INTEGRATORS
from approxjac.simulation.transmission import Motors

_GUESSES = 3
_FINITE = 1e200  # sum of squares, beyond which a run has diverged
_FIXED = {"approxjac", "numpy", "pinocchio", *sys.stdlib_module_names} - {"__main__"}


class _Pickler(pickle.Pickler):
    """A pickler that refuses user code: in a notebook its name may mean something else later."""

    def reducer_override(self, value: Any) -> Any:
        written = isinstance(value, (type, FunctionType))
        if written and value.__module__.partition(".")[0] not in _FIXED:
            raise pickle.PicklingError
        return NotImplemented


def loop_key(*parts: Any) -> bytes:
    """Return a key that equal loops share; an own one for those with parts written by a user."""
    stream = io.BytesIO()
    try:  # what may have been changed since is compared by its value
        _Pickler(stream).dump(parts)
    except (pickle.PicklingError, AttributeError, TypeError):
        return uuid.uuid4().bytes
    return hashlib.sha256(stream.getvalue()).digest()


class TracedLoop:
    """A step of a sampled loop.

    Raises:
        InvalidInputError: A controller or a sensor that cannot be traced, or a plant that is not
            covered.
    """

    truth: Arm  # the true arms
    q: Symbols  # configuration before the step, shape (nq,)
    v: Symbols  # its rate, shape (n_v,)
    x: Symbols  # what the sensor delivers, shape (n_x,)
    error: Symbols  # e, also where no sensor sees x, shape (m,)
    answer: Evaluation  # the law's
    # what is kept; "diverged" and "left" are 1 once numbers became too large, a step was Python's
    after: dict[str, Any]

    def __init__(
        self,
        program: Program,  # program that the step is added to
        controller: Controller,  # the law, with what is around it
        plant: Plant,  # one of the true robots, with its sensor, friction and lateness
        numbers: ArmNumbers,  # of true robots, stacked, such that all differ in what ever differs
        target: Target,  # wanted x; without a rate it is at rest
        dt: float,  # sampling time [s]
        integrator: str,  # one of `INTEGRATORS`
        # numbers of the sensor that differ from run to run, by their names
        sensor: Mapping[str, Symbols] | None = None,
        # sensors and motors as they really are; None is ideal
        sensing: TracedSensing | None = None,
    ) -> None:
        more = (plant.servo, plant.adds_gravity)
        if type(plant) is not Plant or any(part is not None for part in more):
            raise InvalidInputError(
                "plant must be a Plant itself, without a servo and adds_gravity, to "
                f"make code of it, got {plant!r}",
                given=plant,
            )
        robot = plant.robot
        self.truth = Arm(program.given, "truth", robot, tasks.frames(plant.sensor), numbers)
        self.q = q = program.kept("q", robot.nq)
        self.v = v = program.kept("v", robot.nv)
        self.motors = None
        if not plant.is_ideal:
            self.motors = Motors(*(program.kept(name, robot.nv) for name in Motors._fields))
        rests = sensing is None or plant.is_exact  # the guard does, as nothing can be wrong
        first = controller.size if rests else controller.whole_size
        state = program.kept("state", first)
        here = self.truth.at(q)
        value = tasks.value(plant.sensor, here, sensor)
        self.x = x = tasks.seen(plant.sensor, value)
        self.error = tasks.error(plant.sensor, value, target.x)
        may_lose = tasks.may_lose(plant.sensor)
        left: Condition = False
        if sensing is None:
            count = program.kept("count", 1)[0]
            measurement, kept = Measurement(count * dt, q, v, x, count * dt), {"count": count + 1.0}
            measurement = plant.encoded(measurement, self.motors)
        else:
            truth = plant.encoded(Measurement(program.k * dt, q, v, x), self.motors)
            measurement, kept = sensing.measured(program, truth)
            state, left = _initial_state(program, controller, state, measurement)
            may_lose = may_lose or sensing.may_lose
        program.graph.is_finite = not may_lose
        wanted = target.x if target.v is None else target
        after, self.answer, _ = laws.stepped(controller, state, measurement, wanted, dt)
        program.graph.is_finite = False
        acting = self.answer.torque
        if sensing is not None:
            acting, late = sensing.acting(program, acting)
            kept |= late
        with self.truth.standing_in(program.graph):
            q_end, v_end, motors = plant.advance(
                q, v, acting, dt, INTEGRATORS[integrator], self.motors
            )
        kept |= {} if motors is None else motors._asdict()
        changing = [
            b for a, b in zip(after, state, strict=True) if not program.graph.changes_rarely(a, b)
        ]
        parts = q_end, v_end, self.answer.torque, symbols(changing)
        squares = [(each * each).sum() for each in parts]
        left = left | program.graph.left | (squares[0] > LARGEST_ANGLE**2)
        flags = {"diverged": ~(sum(squares, 0.0) < _FINITE), "left": left}
        kept |= {
            name: select(is_so, 1.0, program.kept(name, 1)[0]) for name, is_so in flags.items()
        }
        self.after = {"q": q_end, "v": v_end, "state": after, **kept}


def _initial_state(
    program: Program, controller: Controller, state: Symbols, measurement: Measurement
) -> tuple[Symbols, Condition]:
    """Return the state, set by the first x in the first step, and whether that x is lost."""
    if controller.kinematics is not controller.law.kinematics:
        return state, False
    first = laws.initial_state(controller.law, measurement._replace(t=0.0, t_x=0.0))
    at = [i for i, each in enumerate(first.tolist()) if isinstance(each, Scalar)]
    if not at:
        return state, False
    is_first = program.k < 1.0
    law.alter(is_first, state, lambda state: state.__setitem__(at, first[at]))
    lost = controller.kinematics is None and law.any_of(symbols(is_first) & ~np.isfinite(first[at]))
    return state, lost
