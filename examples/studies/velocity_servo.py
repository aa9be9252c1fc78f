"""`VelocityServo`: the classical baseline, visual servoing of a velocity-controlled arm."""

import numpy as np

import approxjac as aj
from approxjac import law
from approxjac.controllers import Controller
from approxjac.tasks.analysis import vanishing


class VelocityServo(Controller):
    """Image-based visual servoing at velocity level, with an inner velocity loop.

    q̇_ref = −λ Ĵ⁺e,   τ = M̂(q) ω (q̇_ref − q̇) + Ĉ(q, q̇)q̇ + gravity

    The law of F. Chaumette and S. Hutchinson, "Visual servo control, Part I: Basic approaches"
    (IEEE Robotics & Automation Magazine 13(4), 2006), with the image Jacobian taken on to the
    joints; for positions and poses it is D. E. Whitney's resolved motion rate control (1969). With
    a right Ĵ, e decays like exp(−λt). q̇_ref is scaled down as a whole until no joint's is beyond
    its velocity limit; Ĵ⁺ is damped near singular configurations. While x is lost the arm stops.

    The inner loop is the best that a believed robot can have, so that a comparison shows the outer
    law: where M̂, Ĉ and gravity are right, q̈ = ω (q̇_ref − q̇) for each joint by itself. Drives with
    a gain for each joint, ω M̂ᵢᵢ, would not be fairer: the eigenvalues of M⁻¹ diag(Mᵢᵢ) spread their
    bandwidth (on a Panda from 0.4 ω to 13 ω, the medians over configurations).

    Args:
        task: The task of the believed robot.
        rate: λ > 0 [1/s]. 4/T settles to 2 % in about T.
        gravity: `ModelGravity`, `RegressorGravity` or `NoGravity`.
        inner_bandwidth: ω > 0 [1/s], large beside 4λ.
    """

    task = None  # set below: the protocol has a property

    def __init__(self, task, rate, gravity, inner_bandwidth=50.0):
        self.task, self.rate, self.gravity, self.bandwidth = task, rate, gravity, inner_bandwidth
        # gravity is what the controller takes it for, which may be none
        self.dynamics = aj.robots.Dynamics(task.robot.with_gravity((0.0, 0.0, 0.0)))
        self.scale = vanishing(task)  # of a Jacobian that counts as singular as a whole

    def evaluate(self, state, measurement, target):
        """Return the torque for one measurement; there is no state."""
        _, q, v, x, _ = measurement
        J_hat, e = self.task.jacobian(q, x), self.task.error(x, target)
        lost = not np.isfinite(e).all()
        wanted = np.zeros_like(e) if lost else -self.rate * e
        w, damping = law.damped_gram_solve(J_hat @ J_hat.T, wanted, scale=self.scale)
        reference = w @ J_hat
        reference /= max(1.0, np.abs(reference / self.task.robot.velocity_limits).max())
        g = self.gravity.torque(q)
        torque = self.dynamics.inverse(q, v, self.bandwidth * (reference - v)) + g
        status = aj.Status.NEAR_SINGULAR if damping > 0.0 else aj.Status.OK
        status = aj.Status.MEASUREMENT_LOST if lost else status
        return aj.Evaluation(torque, np.zeros(0), status, e, J_hat, g)
