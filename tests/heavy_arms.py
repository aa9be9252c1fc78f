"""Arms that gravity pulls at, each with a tool that its controller does not know of."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import approxjac as aj
from approxjac.controllers import ModelGravity
from approxjac.robots import GravityRegressor


def _link(name, mass, length):
    along = mass * length**2 / 12.0 + 1e-3
    return (
        f'<link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
        f'<inertia ixx="{0.05 * along + 1e-3}" ixy="0" ixz="0" iyy="{along}" iyz="0" '
        f'izz="{along}"/></inertial></link>'
    )


def _joint(name, parent, child, place, axis, low, high, effort):
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{place}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="3"/></joint>'
    )


# a column that turns, a shoulder and an elbow: as many joints as task coordinates
THREE_JOINT = (
    '<robot name="three_joint"><link name="floor"/>'
    + _link("column", 3.0, 0.1)
    + _link("upper", 2.5, 0.5)
    + _link("fore", 1.5, 0.4)
    + '<link name="tip"/>'
    + _joint("turn", "floor", "column", "0 0 0.3", "0 0 1", -2.8, 2.8, 40)
    + _joint("shoulder", "column", "upper", "0.05 0 0.1", "0 1 0", -2, 2, 60)
    + _joint("elbow", "upper", "fore", "0.5 0 0", "0 1 0", -2.6, 2.6, 30)
    + '<joint name="end" type="fixed"><parent link="fore"/><child link="tip"/>'
    '<origin xyz="0.4 0 0"/></joint></robot>'
)

PLACES = {  # configuration, K_p, K_v, B_c, axes of the task
    "panda": ((0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7), 400.0, 80.0, 5.0, "xyz"),
    "ur5": ((0.0, -1.2, 1.5, -1.0, -1.5, 0.0), 900.0, 200.0, 6.0, "xyz"),
    "two_link": ((0.3, 1.2), 400.0, 120.0, 8.0, "xz"),
    "three_joint": ((0.3, -0.6, 1.3), 400.0, 80.0, 4.0, "xyz"),
}
NAMES = tuple(PLACES)


class HeavyArm:
    """One of the arms: the belief, the truth with a tool of 10 cm and 0.3 kg, laws and reports."""

    def __init__(self, name: str, half: float = 0.15) -> None:
        q, self.kp, self.kv, self.damping, axes = PLACES[name]
        self.name, self.q = name, np.array(q)
        source = THREE_JOINT if name == "three_joint" else name
        self.bare = aj.load_robot(source, tip="tip" if name == "three_joint" else None)
        assert np.linalg.norm(self.bare.gravity) > 9.0
        self.belief = self.bare.with_object(0.0)
        self.truth = self.bare.with_object(0.1, 0.3, axis="x")
        self.task = aj.PositionTask(self.belief, axes=axes)
        self.sensor = self.task.on(self.truth)
        self.plant = aj.Plant(self.truth, self.sensor)
        self.gains = aj.Gains(self.kp, self.kv, self.damping)
        self.box = aj.JointBox.around(self.bare, self.q, half)

    @cached_property
    def known(self) -> aj.SetpointController:
        """The law with the true arm's own weight, and the believed Jacobian."""
        return aj.SetpointController(self.task, self.gains, gravity=ModelGravity(self.truth))

    @cached_property
    def learning(self) -> aj.SetpointController:
        """That which learns gravity, wherever θ̂ is."""
        gravity = aj.AdaptiveGravity(self.belief, L=0.05, alpha=0.5, torque_limits=np.inf)
        return aj.SetpointController(self.task, self.gains, gravity=gravity)

    @cached_property
    def theta(self) -> NDArray[np.float64]:
        """What learning would be right with."""
        return GravityRegressor(self.belief).fit(self.truth)[0]

    @cached_property
    def report(self) -> aj.stability.StabilityReport:
        return self.report_of(self.known)

    @cached_property
    def learnt_report(self) -> aj.stability.StabilityReport:
        return self.report_of(self.learning)

    def report_of(self, controller, configurations=40, **options):
        return aj.Study(controller, self.plant, self.box, **options).report(configurations)

    def cross_weight(self, weights, q):
        """G of a Lyapunov function, from the believed Jacobian alone."""
        J_hat = self.task.jacobian(q)
        D = J_hat.T * self.kv @ J_hat + self.damping * np.eye(self.bare.nv)
        return np.linalg.pinv(J_hat) @ weights.A1 + np.linalg.solve(
            D, J_hat.T * self.kv @ weights.A2
        )

    def V(self, weights, q, v, x_d):
        """½q̇ᵀMq̇ + q̇ᵀMGe + ½eᵀ(W + Ω)e, with s(e) = e."""
        M, e = self.plant.dynamics.M(q), self.sensor.value(q) - x_d
        W = np.diag(weights.w) + weights.coupling * np.ones((len(e), len(e)))
        cross = v @ M @ self.cross_weight(weights, q) @ e
        return 0.5 * v @ M @ v + cross + 0.5 * e @ W @ e
