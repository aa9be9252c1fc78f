"""Lead a Franka FR3 through its makers' client: a simulated one, over the protocol of the real one.

The tip of a 20 cm tool, of which neither the controller nor the robot knows, goes to a target 12 cm
away, and along a circle. Needs `pip install 'approxjac[fast,franka]'` and what `make_environment`
makes.

    python examples/franka/over_the_wire.py --runs 20
"""

import argparse
import os
from dataclasses import replace

import numpy as np
from simulated_franka import Camera, SimulatedFranka, missing

import approxjac as aj
from approxjac.codegen import compiled
from approxjac.controllers import AdaptiveDynamics, AdaptiveKinematics, Latency
from approxjac.realtime import FrankaDriver, Scheduling, Tolerances

FAR, DURATION = 0.12, 8.0  # m, s
ALONE = {  # the simulated robot has the last processor
    "scheduling": Scheduling(cpu=min(os.sched_getaffinity(0))),
    "tolerances": Tolerances(max_period=0.5),
}
LATE = {"noise": 1e-3, "rate": 60.0, "late": 0.03}  # of a camera: 1 mm, 60 Hz, 30 ms
STIFF = 0.4  # s, for stiffer gains than by default: friction hides less of the error
ROTORS = 0.1  # inertia of the drives as the joints feel them [kg m²]


def lead(driver, controller, target):
    """Control a robot by machine code, which leaves time for the rest of a period."""
    return aj.control(driver, compiled(controller), target, DURATION, **ALONE)


def reach(robot, seed=0):
    """Bring the tip of a tool that nobody knows to a point."""
    driver = FrankaDriver(robot.address, Camera(robot.truth), realtime=False)
    belief = robot.arm.with_object(0.0)
    rest = aj.AdaptiveGravity(belief, theta0=0.0)  # of gravity, which the robot adds
    law = aj.SetpointController(aj.PositionTask(belief), gravity=rest, settling_time=STIFF)
    controller = aj.TorqueLimited(law, driver.limits)
    return lead(driver, controller, away(driver.read().x, seed))


def reach_by_camera(robot, seed=0):
    """The same by a camera."""
    driver = FrankaDriver(robot.address, Camera(robot.truth, **LATE, seed=seed), realtime=False)
    belief = robot.arm.with_object(0.0)
    rest = aj.AdaptiveGravity(belief, theta0=0.0)
    lags = Latency(torque_delay=1e-3, image_period=1.0 / LATE["rate"], image_age=LATE["late"])
    law = aj.SetpointController(aj.PositionTask(belief), gravity=rest, latency=lags)
    controller = aj.TorqueLimited(law, driver.limits)
    return lead(driver, controller, away(tip(robot, driver.read().q), seed))


def circle(robot, seed=0):
    """Follow a circle of 10 cm in 4 s, twice, with kinematics and dynamics that learn."""
    driver = FrankaDriver(
        robot.address, Camera(robot.truth), gravity=robot.arm, realtime=False
    )  # the tracking law compensates all of gravity
    task = aj.PositionTask(robot.arm.with_object(0.0))
    kinematics = AdaptiveKinematics(task, unknown=("tool", "origins"), noise=1e-4)
    dynamics = AdaptiveDynamics(task.robot, rotor_inertia=ROTORS)
    law = aj.TrackingController(task, kinematics=kinematics, dynamics=dynamics)
    controller = aj.TorqueLimited(law, driver.limits)
    return lead(driver, controller, around(driver.read().x, seed))


def circle_by_velocities(robot, seed=0):
    """The same by joint velocities and a camera."""
    camera = Camera(robot.truth, **LATE, seed=seed)
    driver = FrankaDriver(robot.address, camera, command="velocity", realtime=False)
    task = aj.PositionTask(robot.arm.with_object(0.0))
    kinematics = AdaptiveKinematics(task, unknown=("tool", "origins"), noise=LATE["noise"])
    controller = aj.TrackingController(task, kinematics=kinematics, command="velocity")
    return lead(driver, controller, around(tip(robot, driver.read().q), seed))


def reach_by_velocities(robot, seed=0):
    """Reach by joint velocities."""
    driver = FrankaDriver(robot.address, Camera(robot.truth), command="velocity", realtime=False)
    task = aj.PositionTask(robot.arm.with_object(0.0))
    kinematics = AdaptiveKinematics(task, unknown=("tool", "origins"), noise=1e-4)
    controller = aj.TrackingController(task, kinematics=kinematics, command="velocity")
    return lead(driver, controller, away(driver.read().x, seed))


KINDS = reach, reach_by_camera, circle, reach_by_velocities, circle_by_velocities


def away(x, seed=0):
    """Return a point that is 12 cm away from x: forward, right and up, or as a seed has it."""
    way = np.array([1.0, -1.0, 1.0]) if seed == 0 else np.random.default_rng(seed).normal(size=3)
    return x + FAR * way / np.linalg.norm(way)


def around(x, seed=0):
    """Return a circle of 10 cm in 4 s that begins at x, flat or as a seed has it."""
    normal = (0.0, 0.0, 1.0) if seed == 0 else np.random.default_rng(seed).normal(size=3)
    turn = aj.Circle(center=np.zeros(3), radius=0.1, period=4.0, normal=normal)
    return replace(turn, center=x - turn.at(0.0).x)


def tip(robot, q):
    """Return where the true tip is."""
    return aj.PositionTask(robot.truth).value(q)


def errors(robot, run):
    """Return how far the true tip is from the target until it is brought to rest [m]."""
    n = np.searchsorted(run.t, DURATION)
    return np.linalg.norm([tip(robot, q) for q in run.q[:n]] - run.x_d[:n], axis=1)


def main():
    """Run them all, and say how they went."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=len(KINDS), help="one kind after the other")
    runs = parser.parse_args().runs
    if missing():
        parser.error(missing())
    reflexes = alarms = 0
    for i in range(runs):
        kind = KINDS[i % len(KINDS)]
        with SimulatedFranka() as robot:
            try:
                run = kind(robot, i // len(KINDS))
            except aj.errors.ControlError as error:
                print(f"{kind.__name__:>22}  {error}")
                reflexes += 1
                continue
        if run.fault is not None:
            print(f"{kind.__name__:>22}  {run.ended}")
            alarms += 1
            continue
        error = 1e3 * errors(robot, run)
        told = [f"{error[np.searchsorted(run.t, t)]:.3g} mm at {t:g} s" for t in (1.0, 2.0, 5.0)]
        late = error[np.searchsorted(run.t, 5.0) :]
        gaps = 1e3 * run.gap[1:]
        print(
            f"{kind.__name__:>22}  {', '.join(told)}; later at most {late.max():.3g}, "
            f"rms {np.sqrt(np.mean(late**2)):.3g}; {1e6 * np.median(run.work):.0f} µs of work, "
            f"99 % within {1e6 * np.quantile(run.work, 0.99):.0f}; "
            f"periods {np.median(gaps):.2f} ms, at most {gaps.max():.1f}",
            flush=True,
        )
    print(f"{runs} runs, {reflexes} ended by the robot, {alarms} by a fault")


if __name__ == "__main__":
    main()
