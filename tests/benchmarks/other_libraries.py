"""One step each of what others offer, on the same arm: forward dynamics, a torque, a velocity."""

import numpy as np
import pinocchio as pin

import approxjac as aj


def aba(robot):
    """Pinocchio's forward dynamics: what one step of a simulation needs at least."""
    model, data, tau = robot.model, robot.model.createData(), np.zeros(robot.nv)
    return lambda q, v, x: pin.aba(model, data, q, v, tau)


def operational_space(robot, rows, x_d, stiffness=100.0, damping=20.0):
    """τ = Jᵀ (J M⁻¹ Jᵀ)⁻¹ (−k e − d J q̇) + h(q, q̇), with MuJoCo's kinematics and dynamics.

    As in the usual operational-space loops: `mj_fwdPosition`, `mj_fwdVelocity`, `mj_jac` and
    `mj_solveM`, the rest in NumPy, without any check.
    """
    import mujoco

    model = aj.MujocoPlant(robot, aj.PositionTask(robot, axes="x")).mujoco_model
    data, n = mujoco.MjData(model), robot.nv
    frame = robot.model.frames[robot.model.getFrameId(robot.tip)]
    body = model.joint(robot.model.names[frame.parentJoint]).bodyid[0]
    offset = np.array(frame.placement.translation)
    places = np.array([model.joint(name).dofadr[0] for name in robot.joint_names])
    J_all, M_inv, unit = np.zeros((3, n)), np.zeros((n, n)), np.eye(n)
    position, rotation = data.xpos[body], data.xmat[body].reshape(3, 3)

    def step(q, v, x):
        data.qpos[places], data.qvel[places] = q, v
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_jac(model, data, J_all, None, position + rotation @ offset, body)
        mujoco.mj_solveM(model, data, M_inv, unit)
        J = J_all[rows]
        inertia = np.linalg.inv(J @ M_inv @ J.T)
        force = inertia @ (-stiffness * (x - x_d) - damping * (J @ data.qvel))
        return ((J.T @ force + data.qfrc_bias)[places],)

    return step


def pink_step(robot):
    """Pink's differential inverse kinematics: a joint velocity towards a position of the tip.

    None where Pink is not installed.
    """
    try:
        import pink
    except ImportError:
        return None
    model = pin.Model(robot.model)
    configuration = pink.Configuration(model, model.createData(), robot.neutral())
    task = pink.FrameTask(robot.tip, position_cost=1.0, orientation_cost=0.0)
    task.set_target(pin.SE3(np.eye(3), np.array([0.4, 0.0, 0.4])))

    def step(q, v, x):
        configuration.update(q)
        return pink.solve_ik(configuration, [task], 1e-3, solver="daqp", safety_break=False)

    return step
