"""Mimic joints: joints that move in proportion to another, such as the second finger of a hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from lxml import etree

from approxjac.errors import UrdfError
from approxjac.robots.urdf import Follows, Urdf, leader_of
from approxjac.validation import Array


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


def build_coupled(urdf: Urdf) -> tuple[pin.Model, MimicJoints]:
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
