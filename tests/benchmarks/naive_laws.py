"""The laws as one types them in from the paper, with NumPy and Pinocchio, to compare ours with.

Dense gain matrices, `np.linalg.pinv`, Pinocchio's whole regressor and its columns by index. They
answer with a torque (and the rate of what is learnt) and no more. Their gains are those of our
controllers, whose torque is the same to rounding (tests/test_benchmarks.py).
"""

import numpy as np
import pinocchio as pin

from approxjac.robots import GravityRegressor

KP, KV, DAMPING = 400.0, 80.0, 1.0
IMAGE_KP, IMAGE_KV = 1e-3, 1e-3
GAMMA, LEARNING, ALPHA, LAG, STIFFNESS = 0.1, 0.5, 2.0, 0.02, 5.0
WORLD = pin.LOCAL_WORLD_ALIGNED


def jacobian(robot, rows):
    """Ĵ(q) of the robot's tip along some axes."""
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.tip)

    def J(q):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        return pin.getFrameJacobian(model, data, frame, WORLD)[rows]

    return J


def image_jacobian(robot, camera):
    """Ĵ(q) of the image of the robot's tip."""
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.tip)
    f, c = camera.focal_length, np.array(camera.position)
    R = np.array(camera.rotation)

    def J(q):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        x, y, z = R.T @ (data.oMf[frame].translation - c)
        L = np.diag(f) @ np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
        return L @ R.T @ pin.getFrameJacobian(model, data, frame, WORLD)[:3]

    return J


def setpoint(robot, J_of, m, x_d, kp, kv, *, sine=False, learning=False, lag=None, posture=None):
    """The laws (5), (6) and (28), (29) as a function of (q, v, x)."""
    model, data, n = robot.model, robot.model.createData(), robot.nv
    Kp, Kv, B = kp * np.eye(m), kv * np.eye(m), DAMPING * np.eye(n)
    if learning:
        regressor = GravityRegressor(robot)
        movers, offsets = list(model.names)[1:], ["m", "mx", "my", "mz"]
        pairs = [name.rsplit(".", 1) for name in regressor.names]
        columns = np.array([10 * movers.index(a) + offsets.index(b) for a, b in pairs])
        L, theta_hat = LEARNING * np.eye(regressor.p), regressor.theta.copy()
    followed = x_d

    def step(q, v, x):
        J = J_of(q)
        e = x - x_d
        s = GAMMA * np.sin(np.clip(e / GAMMA, -np.pi / 2, np.pi / 2)) if sine else e
        x_dot = J @ v if lag is None else (x - followed) / lag
        tau = -J.T @ (Kp @ s + Kv @ x_dot) - B @ v
        if posture is not None:
            pull = -STIFFNESS * pin.difference(model, posture, q)
            tau = tau + (np.eye(n) - np.linalg.pinv(J) @ J) @ pull
        if not learning:
            tau = tau + pin.computeGeneralizedGravity(model, data, q)
            return (tau,) if lag is None else (tau, x_dot)
        Z = pin.computeJointTorqueRegressor(model, data, q, np.zeros(n), np.zeros(n))[:, columns]
        y = v + ALPHA * np.linalg.pinv(J) @ s
        return tau + Z @ theta_hat, -L @ Z.T @ y

    return step


def checked(robot, J_of, x_d, step, learning=False):
    """A step with the checks that ours makes, written out plainly.

    Numbers that are not finite, a Jacobian near a singular pose, and, where gravity is learnt,
    torques beyond the limits.
    """
    limits = robot.effort_limits

    def with_checks(q, v, x):
        if not all(np.isfinite(values).all() for values in (q, v, x, x_d)):
            raise ValueError
        values = np.linalg.svd(J_of(q), compute_uv=False)
        status = int(values[-1] < 0.02 * values[0])
        answer = step(q, v, x)
        if learning and (np.abs(answer[0]) > limits).any():
            status = 2
        return answer, status

    return with_checks
