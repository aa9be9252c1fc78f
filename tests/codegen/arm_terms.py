"""Terms of an arm through the graph, in NumPy, and of Pinocchio."""

import numpy as np
import pinocchio as pin

from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import inputs
from approxjac.robots import Dynamics
from approxjac.robots.traced import moved
from approxjac.tasks.frame_tasks import FrameKinematics


def traced(robots, frames, regressor=None):
    """Return the program and its terms: name → array of symbols."""
    program = Program()
    robot = robots[0]
    q, v, tau = (
        inputs(program.graph, *each)
        for each in (("q", robot.nq), ("v", robot.nv), ("tau", robot.nv))
    )
    here = Arm(program.given, "arm", robot, frames, stacked(robots, frames)).at(q)
    terms = {"M": here.M(), "g": here.gravity(), "inverse": here.inverse(v, tau)}
    terms |= {"forward": here.forward(v, tau), "moved": moved(robot, q, v)}
    for frame in frames:
        R, p = here.frame(frame)
        terms |= {f"R {frame}": R, f"p {frame}": p, f"J {frame}": here.jacobian(frame)}
        terms |= {f"J_dot {frame}": here.jacobian_dot(frame, v)}
    if regressor is not None:
        terms["Z"] = here.Z(regressor)
    return program, terms


def stacked(robots, frames):
    return ArmNumbers.stacked([arm_numbers(robot, frames) for robot in robots])


def evaluated(program, terms, q, v, tau, **parameters):
    """Return the terms' values, name → (N, …), at inputs of shape (N, …)."""
    numbers = [number for term in terms.values() for number in np.ravel(term).tolist()]
    given = {name: values.T for name, values in {"q": q, "v": v, "tau": tau, **parameters}.items()}
    rows = numpy_function(program.graph, numbers)(**given)
    values = np.array([np.broadcast_to(row, len(q)) for row in rows]).T
    found, at = {}, 0
    for name, term in terms.items():
        size = int(np.size(term))
        found[name] = values[:, at : at + size].reshape(-1, *np.shape(term))
        at += size
    return found


def expected(robot, frames, regressor, q, v, tau):
    """Return the same of Pinocchio at one q, v and tau."""
    dynamics, model = Dynamics(robot), robot.model
    terms = {"M": dynamics.M(q), "g": dynamics.g(q)}
    terms["inverse"] = dynamics.inverse(q, v, tau)
    # Pinocchio's articulated bodies keep 11 digits only where masses differ much
    terms["forward"] = np.linalg.solve(terms["M"], tau - dynamics.inverse(q, v, 0 * v))
    terms["moved"] = pin.integrate(model, q, v)
    for frame in frames:
        kinematics = FrameKinematics(robot, frame)
        R, p = kinematics.placement(q)
        data = model.createData()
        J = pin.computeFrameJacobian(
            model, data, q, robot.frame_id(frame), pin.LOCAL_WORLD_ALIGNED
        ).reshape(6, -1)
        terms |= {f"R {frame}": R, f"p {frame}": p, f"J {frame}": J}
        terms |= {f"J_dot {frame}": kinematics.jacobian_dot(q, v)}
    if regressor is not None:
        terms["Z"] = regressor.Z(q)
    return terms


def largest_errors(robots, frames, regressor, rng, samples=20):
    """Return name → largest error relative to the largest entry, at random q, v and tau."""
    robot = robots[0]
    N = samples if len(robots) == 1 else len(robots)
    q = np.array([robot.random_configuration(rng) for _ in range(N)])
    v, tau = rng.normal(size=(2, N, robot.nv))
    program, terms = traced(robots, frames, regressor)
    arms = robots * N if len(robots) == 1 else robots
    found = evaluated(program, terms, q, v, tau, **parameters(program, robots, frames))
    each = [
        expected(arm, frames, regressor, *row) for arm, *row in zip(arms, q, v, tau, strict=True)
    ]
    errors = {}
    for name, value in found.items():
        right = np.array([one[name] for one in each])
        least = 1e-3 if name.startswith("J_dot") else 1e-300  # nothing but round-off of some
        errors[name] = np.abs(value - right).max() / max(np.abs(right).max(), least)
    return errors


def parameters(program, robots, frames):
    """Return the values of the parameters of a program of `traced`, as (N, rows)."""
    kept = {}

    def given(name, values):
        flat = values.reshape(len(values), -1)
        kept[name] = flat[:, (flat != flat[:1]).any(axis=0)]
        return Program().given(name, values)

    Arm(given, "arm", robots[0], frames, stacked(robots, frames))
    return {name: values for name, values in kept.items() if values.size}
