"""From a URDF to a Pinocchio model that torque control can work with, mimic joints included."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from lxml import etree

from approxjac.errors import UrdfError
from approxjac.robots.urdf import Follows, Urdf, leader_of
from approxjac.validation import Array

_MOST_MOVING = 150  # Pinocchio's scratch memory grows with the cube of it
WORLD = pin.Convention.WORLD  # members of Pinocchio's enums are slow to look up


class MimicJoints(NamedTuple):
    """All moving joints as they follow from the n_v that move on their own: q_all = A q + b.

    Pinocchio can leave mimic joints out of q and v, but not every algorithm of it can. Those that
    cannot refuse such a model, or (mass and Coriolis matrix, Jacobian rates) return something else
    without a word. They are run on `model`, in which every joint moves on its own, and brought
    back with v_all = G v, which is constant. Where nothing is coupled, `model` is the robot's own
    model and every method returns what it is given.
    """

    model: pin.Model
    G: Array | None = None  # (n_all, n_v), None where nothing is coupled
    A: Array | None = None  # (nq_all, nq)
    b: Array | None = None  # (nq_all,)

    def q(self, q: Array) -> Array:
        """Configuration of all joints, shape (nq_all,)."""
        return q if self.A is None or self.b is None else self.A @ q + self.b

    def v(self, v: Array) -> Array:
        """Velocities of all joints, shape (n_all,)."""
        return v if self.G is None else self.G @ v

    def columns(self, J: Array) -> Array:
        """J G: from a Jacobian in all velocities to one in v, shape (…, n_v)."""
        return J if self.G is None else J @ self.G

    def rows(self, tau: Array) -> Array:
        """Gᵀ τ: from torques at all joints to those at the n_v, shape (n_v, …)."""
        return tau if self.G is None else self.G.T @ tau


def _build_coupled(urdf: Urdf) -> tuple[pin.Model, MimicJoints]:
    """Return the Pinocchio model of a URDF, without mimic joints in q and v, and how these move."""
    root = urdf.copy().root
    # not every parser takes every geometry, nor instructions
    etree.strip_tags(root, etree.Comment, etree.ProcessingInstruction)
    etree.strip_elements(root, "visual", "collision")
    model = pin.buildModelFromXML(etree.tostring(root, encoding="unicode"))
    names = list(model.names)
    coupled = {joint: follows for joint, follows in urdf.followers.items() if joint in names}
    if not coupled:
        return model, MimicJoints(model)
    followed = {joint: leader_of(joint, coupled) for joint in coupled}
    for joint, (leader, multiplier, offset) in followed.items():
        fault = _fault(model, joint, leader, coupled)
        if fault:
            raise UrdfError(
                f"{urdf.source}: joint {joint!r} mimics {leader!r}, {fault}; make it fixed, or "
                "take its <mimic> away",
                given=urdf.source,
            )
        (mimic,) = root.xpath("joint[@name=$name]/mimic[1]", name=joint)
        follows = {"joint": leader, "multiplier": str(multiplier), "offset": str(offset)}
        mimic.attrib.update(follows)
    reduced = pin.buildModelFromXML(etree.tostring(root, encoding="unicode"), True)
    A, b = np.zeros((model.nq, reduced.nq)), np.zeros(model.nq)
    G = np.zeros((model.nv, reduced.nv))
    for name, own, kept in zip(names[1:], list(model.joints)[1:], reduced.joints[1:], strict=True):
        # the indices of a mimic joint are those of its leader
        _, multiplier, offset = followed.get(name, (name, 1.0, 0.0))
        np.fill_diagonal(A[own.idx_q :, kept.idx_q :][: own.nq], multiplier)
        np.fill_diagonal(G[own.idx_v :, kept.idx_v :][: own.nv], multiplier)
        b[own.idx_q] = offset
    return reduced, MimicJoints(model, G, A, b)


def _fault(model: pin.Model, joint: str, leader: str, coupled: Mapping[str, Follows]) -> str:
    """Say why a joint cannot follow another, or nothing."""
    names = list(model.names)
    if leader in coupled:
        return "and the other way round"
    if leader not in names:
        return "which does not move"
    follower, led = names.index(joint), names.index(leader)
    if any(model.joints[i].nq != 1 for i in (follower, led)):
        return "and one of them is continuous, which Pinocchio cannot couple"
    if led > follower:
        return "which comes after it in Pinocchio's order of joints, so that it cannot couple them"
    return ""


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
        model, mimic_joints = _build_coupled(urdf)
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
    """M(q) by CRBA, made symmetric, of the model and data in which every joint moves by itself.

    With mimic joints Pinocchio's CRBA is wrong where what one of them moves has branches.
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
