"""Time of one control step, as a ratio to the same law typed in with NumPy and Pinocchio.

The bare step is what one writes from the paper: dense gain matrices, `np.linalg.pinv`, the whole
regressor and its columns by index; it answers with a torque and no more. The checked step says as
much as ours: it looks for numbers that are not finite, for a Jacobian near a singular pose, and,
where gravity is learnt, for torques beyond the limits. All run in turn in one process.

    python tests/benchmarks/control_step.py
"""

import time

import numpy as np
import pinocchio as pin

import approxjac as aj

ROUNDS, STEPS = 60, 400


def naive_steps(robot, frame, saturated, learning):
    """The laws (6) and (28), (29) as a function of (q, v, x), written out plainly."""
    model, data = robot.model, robot.model.createData()
    frame_id = model.getFrameId(frame)
    m, n = 3, model.nv
    Kp, Kv, B = 400.0 * np.eye(m), 80.0 * np.eye(m), 1.0 * np.eye(n)
    gamma, alpha = 0.1, 2.0
    regressor = aj.GravityRegressor(robot)
    columns = np.array(regressor._columns)
    L, theta_hat = 0.5 * np.eye(regressor.p), regressor.theta.copy()
    x_d = np.zeros(m)

    def step(q, v, x):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        J = pin.getFrameJacobian(model, data, frame_id, pin.LOCAL_WORLD_ALIGNED)[:m]
        e = x - x_d
        s = gamma * np.sin(np.clip(e / gamma, -np.pi / 2, np.pi / 2)) if saturated else e
        tau = -J.T @ (Kp @ s + Kv @ (J @ v)) - B @ v
        if not learning:
            return tau + pin.computeGeneralizedGravity(model, data, q)
        Z = pin.computeJointTorqueRegressor(model, data, q, np.zeros(n), np.zeros(n))[:, columns]
        y = v + alpha * np.linalg.pinv(J) @ s
        return tau + Z @ theta_hat, -L @ Z.T @ y

    return step


def checked_steps(robot, frame, saturated, learning):
    """The naive step with the checks that ours makes, written out plainly."""
    step = naive_steps(robot, frame, saturated, learning)
    model, data = robot.model, robot.model.createData()
    frame_id = model.getFrameId(frame)
    x_d, limits = np.zeros(3), robot.effort_limits

    def checked(q, v, x):
        if not all(np.isfinite(values).all() for values in (q, v, x, x_d)):
            raise ValueError
        J = pin.computeFrameJacobian(model, data, q, frame_id, pin.LOCAL_WORLD_ALIGNED)[:3]
        values = np.linalg.svd(J, compute_uv=False)
        status = int(values[-1] < 0.02 * values[0])
        answer = step(q, v, x)
        if learning and (np.abs(answer[0]) > limits).any():
            status = 2
        return answer, status

    return checked


def our_steps(robot, frame, saturated, learning):
    gravity = None
    if learning:
        gravity = aj.AdaptiveGravity(aj.GravityRegressor(robot), L=0.5, alpha=2.0)
    controller = aj.SetpointController(
        aj.PositionTask(robot, frame),
        aj.Gains(400.0, 80.0, 1.0),
        gravity=gravity,
        saturation=aj.Sine(0.1) if saturated else None,
    )
    x_d = np.zeros(3)
    first = aj.Measurement(0.0, robot.neutral(), np.zeros(robot.nv), x_d)
    state = controller.initial_state(first)
    evaluate = controller.evaluate

    def step(q, v, x):
        return evaluate(state, aj.Measurement(0.0, q, v, x), x_d)

    return step


def aba_steps(robot):
    model, data, tau = robot.model, robot.model.createData(), np.zeros(robot.nv)
    return lambda q, v, x: pin.aba(model, data, q, v, tau)


def measure(steps, inputs):
    """Median over rounds of each step's time [µs]; the steps take turns, so noise hits all."""
    times = np.empty((ROUNDS, len(steps)))
    for i in range(ROUNDS):
        for j, step in enumerate(steps):
            start = time.perf_counter()
            for q, v, x in inputs:
                step(q, v, x)
            times[i, j] = (time.perf_counter() - start) / len(inputs)
    return 1e6 * np.median(times, axis=0)


def main():
    heads = ("ours", "bare", "checked", "aba", "ours/bare", "ours/checked", "ours/aba")
    print(f"{'robot':10}{'law':>17}" + "".join(f"{head:>{len(head) + 3}}" for head in heads))
    rng = np.random.default_rng(0)
    for name in ("ur5", "panda"):
        robot = aj.load_robot(name)
        middle = robot.random_configuration(rng)
        inputs = [
            (
                pin.integrate(robot.model, middle, rng.uniform(-0.3, 0.3, robot.nv)),
                rng.uniform(-0.1, 0.1, robot.nv),
                rng.uniform(-0.05, 0.05, 3),
            )
            for _ in range(STEPS)
        ]
        for law, saturated, learning in (
            ("(6)", False, False),
            ("(6), sine", True, False),
            ("(28), (29)", False, True),
            ("(28), (29), sine", True, True),
        ):
            options = (robot, robot.tip, saturated, learning)
            ours, bare, checked = (
                our_steps(*options),
                naive_steps(*options),
                checked_steps(*options),
            )
            torque = bare(*inputs[0])[0] if learning else bare(*inputs[0])
            np.testing.assert_allclose(ours(*inputs[0]).torque, torque, atol=1e-9)
            a, b, c, d = measure([ours, bare, checked, aba_steps(robot)], inputs)
            figures = (f"{a:.2f}", f"{b:.2f}", f"{c:.2f}", f"{d:.2f}")
            figures += (f"{a / b:.2f}", f"{a / c:.2f}", f"{a / d:.2f}")
            cells = zip(heads, figures, strict=True)
            print(f"{name:10}{law:>17}" + "".join(f"{x:>{len(head) + 3}}" for head, x in cells))
    print("times in µs, medians")


if __name__ == "__main__":
    main()
