"""From URDF text to a Pinocchio model that torque control can work with."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.errors import UrdfError
from approxjac.robots.mimic_joints import MimicJoints, build_coupled
from approxjac.robots.urdf import Urdf
from approxjac.validation import Array

_MOST_MOVING = 150  # Pinocchio's scratch memory grows with the cube of it
WORLD = pin.Convention.WORLD  # members of Pinocchio's enums are slow to look up


def build_model(urdf: Urdf) -> tuple[pin.Model, MimicJoints]:
    """Return the Pinocchio model of a URDF, and how mimic joints follow from its joints."""
    source = urdf.source
    moving = sum(joint.type != "fixed" for joint in urdf.joints.values())
    if moving > _MOST_MOVING:
        raise UrdfError(
            f"{source} must have at most {_MOST_MOVING} joints that move, got {moving}; with "
            "tip=... those that do not move the tip are locked",
            given=source,
        )
    try:
        model, mimic_joints = build_coupled(urdf)
    except UrdfError:  # ours, which says more
        raise
    except (ValueError, RuntimeError) as error:
        raise UrdfError(f"{source} is not a valid URDF: {error}", given=source) from error
    if model.nv == 0:
        raise UrdfError(f"{source} has no moving joint", given=source)
    independent = mimic_joints.model
    for name, joint in zip(independent.names[1:], list(independent.joints)[1:], strict=True):
        if joint.nv != 1:
            raise UrdfError(
                f"{source}: joint {name!r} has {joint.nv} degrees of freedom; every joint of an "
                "arm must be revolute, continuous, prismatic or fixed; the arm on a base that "
                f"moves is loaded with tip=... and base={urdf.joints[name].child!r}, or a link "
                "beyond",
                given=source,
            )
    require_inertia(model, mimic_joints, source)
    return model, mimic_joints


def own_joints(model: pin.Model) -> dict[str, Any]:
    """Return name → Pinocchio joint of those that move on their own, in the order of v."""
    joints = zip(list(model.names)[1:], list(model.joints)[1:], strict=True)
    return {name: joint for name, joint in joints if joint.nv == 1}  # a mimic joint has nv 0


def mass_matrix(mimic_joints: MimicJoints, data: pin.Data, q: Array) -> Array:
    """M(q) by CRBA, which fills the upper triangle only, made symmetric; shape (n_v, n_v).

    Of the model in which every joint moves on its own, whose `data` it takes: of one with mimic
    joints Pinocchio's CRBA is wrong where what one of them moves has branches.
    """
    M = symmetric(pin.crba(mimic_joints.model, data, mimic_joints.q(q), WORLD))
    return M if mimic_joints.G is None else symmetric(mimic_joints.rows(mimic_joints.columns(M)))


def symmetric(upper: Array) -> Array:
    """Return a symmetric matrix of its upper triangle, as Pinocchio gives it, shape (n, n)."""
    return np.where(_is_lower(len(upper)), upper.T, upper)


@cache
def _is_lower(n: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.tri(n, k=-1, dtype=bool)


def outward_axis(model: pin.Model, frame: int) -> str:
    """Return the axis of a frame, "-z", …, along which the last three joints at zero lead to it."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    joints = list(model.supports[model.frames[frame].parentJoint])[1:] or [0]
    lever = -data.oMf[frame].actInv(data.oMi[joints[-3:][0]].translation)
    k = int(np.abs(lever).argmax()) if np.linalg.norm(lever) > 1e-9 else 2
    return ("" if lever[k] >= 0.0 else "-") + "xyz"[k]


def require_inertia(model: pin.Model, mimic_joints: MimicJoints, source: str) -> None:
    """Refuse a robot whose inertia matrix is singular: no torque control is possible.

    What is fixed to the base may have any inertia, and in URDFs that people use some of it has.
    """
    for name, inertia in zip(list(model.names)[1:], list(model.inertias)[1:], strict=True):
        moments = np.linalg.eigvalsh(inertia.inertia)
        if inertia.mass < 0.0 or moments[0] < -1e-9 * max(1e-9, abs(moments[-1])):
            raise UrdfError(
                f"{source}: the links moved by {name} have a negative mass or inertia "
                f"({inertia.mass:g} kg, principal moments {moments.tolist()} kg m^2)",
                given=source,
            )
    M = mass_matrix(mimic_joints, mimic_joints.model.createData(), pin.neutral(model))
    eigenvalues, vectors = np.linalg.eigh(M)
    if eigenvalues[0] > 1e-12 * eigenvalues[-1] > 0.0:
        return
    loose = list(own_joints(model))[int(np.abs(vectors[:, 0]).argmax())]
    raise UrdfError(
        f"{source}: nothing with inertia is moved by joint {loose!r} (the inertia matrix is "
        "singular); torque control needs <inertial> with mass and inertia on what each joint moves",
        given=source,
    )
