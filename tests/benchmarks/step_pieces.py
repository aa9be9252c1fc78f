"""What each piece of a control step costs, on a Panda, beside the bare law.

Each piece is called as the controller calls it; what is left is Python's own calls and the answer.

    python tests/benchmarks/step_pieces.py
"""

import control_step
import naive_laws as naive
import numpy as np
import pinocchio as pin
import turns

from approxjac import law

ROUNDS = 60
HEADS = ("piece", "(6), µs", "of bare", "(28), (29), µs", "of bare")
PIECES = (
    "Pinocchio",
    "the equations in NumPy",
    "singular poses: Ĵ Ĵᵀ, and its solve in (29)",
    "limits of torques",
    "the measurement, and a look at all arguments",
    "Python's calls, the answer",
    "all",
    "bare",
)


def pieces(controller, bare, inputs):
    """Seconds of every piece of a step of law (6), or (28), (29) where gravity is learnt."""
    task, learning = controller.task, controller.adaptation
    robot, frame = task.robot, task.robot.frame_id(task.frame)
    model, data, gravity_data = robot.model, robot.model.createData(), robot.model.createData()
    kp, kv, damping = controller.diagonals
    at_rest = np.zeros(robot.nv)
    q, _, x = inputs[0]
    J, s, alpha = task.jacobian(q), x.copy(), controller._alpha
    x_d, scale = np.zeros(3), controller.pinv.scale
    state = np.zeros(0) if learning is None else learning.theta0
    if learning is None:
        g = controller.gravity.torque(q).copy()
    else:
        Z = learning.regressor.Z(q)
        g = law.gravity(Z, state)

    def pinocchio(q, v, x):
        pin.computeFrameJacobian(model, data, q, frame, naive.WORLD)
        if learning is None:
            pin.computeGeneralizedGravity(model, gravity_data, q)
        else:
            pin.computeJointTorqueRegressor(model, gravity_data, q, at_rest, at_rest)

    def regressor_in_pinocchio(q, v, x):
        pin.computeJointTorqueRegressor(model, gravity_data, q, at_rest, at_rest)

    def equations(q, v, x):
        e = x - x_d
        if learning is not None:
            law.gravity(Z, state)
            law.theta_hat_rate(learning.L, Z, law.passive_output(v, s.dot(J), alpha))
        law.estimated_velocity_torque(J, kp, kv, e, v, damping, g)

    def singular(q, v, x):
        G = J.dot(J.T)
        if learning is None:
            law.is_near_singular(G, scale=scale)
        else:
            law.damped_gram_solve(G, s, scale=scale)

    steps = {
        "Pinocchio": pinocchio,
        "the equations in NumPy": equations,
        "singular": singular,
        "answer": lambda q, v, x: controller._answer(q, v, x, x - x_d, state, None, False),
        "all": control_step.our_step(controller),
        "bare": bare,
        "nothing": lambda q, v, x: None,
    }
    if learning is not None:
        steps["limits"] = lambda q, v, x: learning.rests(g)
        steps["Z"] = lambda q, v, x: learning.regressor.Z(q)
        steps["Z in Pinocchio"] = regressor_in_pinocchio
    taken = turns.medians(steps, inputs, ROUNDS)
    taken = {name: each - taken["nothing"] for name, each in taken.items()}
    if learning is not None:
        taken["the equations in NumPy"] += taken["Z"] - taken["Z in Pinocchio"]
    found = {
        "Pinocchio": taken["Pinocchio"],
        "the equations in NumPy": taken["the equations in NumPy"],
        "singular poses: Ĵ Ĵᵀ, and its solve in (29)": taken["singular"],
        "limits of torques": taken.get("limits", 0.0),
        "the measurement, and a look at all arguments": taken["all"] - taken["answer"],
    }
    found["Python's calls, the answer"] = taken["all"] - sum(found.values())
    return found | {"all": taken["all"], "bare": taken["bare"]}


def rows():
    """Time [µs] and share of the bare law, of every piece of both laws."""
    _, _, inputs = control_step.arm("panda")
    laws = {each.name: each for each in control_step.laws("panda")}
    known, learnt = (
        pieces(laws[name].controller, laws[name].bare, inputs) for name in ("(6)", "(28), (29)")
    )
    return [
        (
            name,
            1e6 * known[name],
            known[name] / known["bare"],
            1e6 * learnt[name],
            learnt[name] / learnt["bare"],
        )
        for name in PIECES
    ]


def main():
    print(turns.table(HEADS, rows()))


if __name__ == "__main__":
    main()
