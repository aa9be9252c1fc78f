"""Closed loops of a controller whose believed robot is wrong, with the terms of their proofs."""

import numpy as np

import approxjac as aj


def closed_loop(name, saturation, seed=0):
    """A true robot with a tool and a shifted joint, and a controller that knows of neither."""
    rng = np.random.default_rng(seed)
    arm = aj.load_robot(name)
    axes = "xz" if arm.nv == 2 else "xyz"
    truth = arm.with_object(0.2, 0.5)
    belief = arm.with_object(0.0).with_kinematic_error({arm.joint_names[1]: (0.02, -0.03, 0.01)})
    task = aj.PositionTask(belief, axes=axes)
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes), friction=0.3)
    gains = aj.Gains(
        rng.uniform(100.0, 500.0, task.m), rng.uniform(30.0, 90.0, task.m),
        rng.uniform(0.5, 3.0, arm.nv),
    )  # fmt: skip
    controller = aj.SetpointController(
        task, gains, gravity=aj.controllers.ModelGravity(truth), saturation=saturation
    )
    return plant, controller, rng


def terms(plant, controller, q):
    dynamics, task, units = plant.dynamics, controller.task, np.eye(plant.robot.nv)
    dM = np.array([dynamics.M_dot(q, unit) for unit in units])
    dJ_hat = np.array([task.jacobian_dot(q, unit) for unit in units])
    return dynamics.M(q), dM, plant.sensor.jacobian(q), task.jacobian(q), dJ_hat
