"""`rest_error`: how far from its target an arm with dry friction may come to rest."""

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError, package_of
from approxjac.robots import Friction
from approxjac.stability.certificates.certificate import inverse
from approxjac.stability.errors.region import require_law
from approxjac.validation import Array, as_array, require

_FAR = 1e9  # an error at which a saturation that is bounded has its bound


def rest_error(controller: SetpointController, friction: Friction, q: Array) -> Array:
    """Return the largest errors with which an arm whose gravity is known may stand at q.

    A joint stands while abs(Ĵᵢᵀ K_p s(e)) ≤ Fᵢ, its static friction. These s are a polytope, whose
    largest coordinates linear programs find. It holds for any true arm. `FrictionCompensation`
    removes these errors, without a bound of its own.

    Args:
        controller: A law (6).
        friction: Friction of the true joints.
        q: A configuration, shape (nq,).

    Returns:
        Largest abs(e) of each coordinate, shape (m,) [unit of the task]; infinite where s(e) is
        bounded and the motors never overcome the friction.

    Raises:
        InvalidInputError: A law that learns or compensates, or a task that is singular at q.
        MissingPackageError: SciPy is not installed.
    """
    controller = require_law(controller)
    if controller.adaptation is not None or controller.friction is not None:
        raise InvalidInputError(
            "controller must be a law (6) without learnt gravity and friction compensation, which "
            f"do not rest, got {controller!r}",
            given=controller,
        )
    task, robot = controller.task, controller.task.robot
    rubs = require("friction", friction, Friction, "Friction(...)").of(robot.nv)
    q = as_array("q", q, (robot.nq,))
    load = np.abs(controller.gravity_torque(np.zeros(0), q))
    static = rubs.stribeck * np.asarray(rubs.coulomb) + np.asarray(rubs.load) * load
    forces = task.jacobian(q, task.value(q)).T * controller.diagonals.kp  # of s on joints, (n_v, m)
    if np.linalg.matrix_rank(forces) < task.m:
        message = f"q must be a configuration in which Ĵ has full rank, got {q.tolist()}"
        raise InvalidInputError(message, given=q)
    linprog = package_of("study", "scipy.optimize").linprog
    sides, most = np.concatenate([forces, -forces]), np.concatenate([static, static])
    s = np.array([
        -linprog(-unit, A_ub=sides, b_ub=most, bounds=(None, None)).fun for unit in np.eye(task.m)
    ])  # fmt: skip
    reached = controller.saturation.s(np.full(task.m, _FAR)) > s
    return np.where(reached, inverse(controller.saturation.s, s, _FAR), np.inf)
