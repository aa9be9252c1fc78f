"""The loop of a robot at 1 kHz around any controller of approxjac: a file to copy and to change.

`11_your_own_loop.py` runs it on a simulated arm, the page "Into your own loop" explains it.
"""

import gc
import itertools
import math
import time

import numpy as np

import approxjac as aj
from approxjac.errors import MeasurementError

DT = 1e-3  # of the loop, and of the controllers in it [s]
UNKNOWN = -1  # in place of a Status, where q or q̇ was not finite


def control(
    arm, controller, goal, stop, *, unseen, speed, astray, longest, fastest=None, patience=2.0,
    rows=60_000,
):  # fmt: skip
    """Lead an arm until it is to stop or something is wrong; brake it to standstill; say why.

    It does not begin where the limits do not hold the arm, as believed.

    Args:
        arm: The driver: `read()` returns q, q̇ and x, NaN where x is lost; `send(torque)`; and
            `brake()`, which hands the arm back to its own brakes or its own controller.
        controller: TorqueLimited around a SetpointController, for DT. A SetpointController alone
            sends whatever torque the law asks for.
        goal: Where to go at time t [s], a function that returns x_d, shape (n_x,). t counts cycles:
            it stands still while periods are missed.
        stop: Whether to stop at time t [s], a function too.
        unseen: As for HeldMeasurement [unit of the task].
        speed: Of the target on its way to the goal [unit of the task, per s; of a pose 1 m and
            1 rad alike].
        astray: Error to that target after which to stop [unit of the task]: x is not what the
            controller takes it for, or the arm is stuck.
        longest: Time from torque to torque after which to stop [s].
        fastest: Joint speeds above which the brakes close at once, shape (n_v,) [rad/s or m/s];
            1.2 times the URDF's by default.
        patience: Time without images, or with limits that void the proof, likewise [s].
        rows: Cycles that are logged: the last ones.

    Returns:
        Why it stopped; the log, a structured array with a row for each cycle; and θ̂, for the
        `theta0` of the next run's AdaptiveGravity.
    """
    held, task = aj.HeldMeasurement(controller, unseen), controller.task
    fastest = 1.2 * task.robot.velocity_limits if fastest is None else np.asarray(fastest)
    aim, fault, slowest = None, "", math.inf
    unknown = troubled = stopping = 0  # cycles
    limit, slack, gap = aj.LimitStatus.UNLIMITED, 0.0, 0.0
    try:
        q, v, x = arm.read()
        # mistakes show here, before the arm moves
        state = held.initial_state(aj.Measurement(0.0, q, v, x))
        wanted = goal(0.0)
        held.step(state, aj.Measurement(0.0, q, v, x), wanted, DT)
        hold = aj.Measurement(0.0, q, np.zeros_like(v), np.full_like(x, np.nan))
        inner = controller.initial_state(hold)
        answer = controller.step(inner, hold, wanted, DT)[1]
        require_held(controller, answer)
        log, torque = new_log(controller, inner, rows), answer.torque
        sizes = {held: len(state), controller: len(inner)}
        gc.disable()  # its pauses may be longer than a period
        due = sent = time.perf_counter()
        for k in itertools.count():
            wait_until(due)
            began, t = time.perf_counter(), k * DT
            q, v, x = arm.read()
            pace = np.abs(v).max()
            off = task.error(x, x if aim is None else aim)
            off = np.where(np.isfinite(off), off, 0.0)  # what is lost is another matter
            faults = {
                "too fast": (np.abs(v) > fastest).any(),
                "joints unknown": unknown > 10,
                "far from its target": np.linalg.norm(off) > astray,
                "a torque came too late": gap > longest,
                "blind, or at its limits, for too long": troubled * DT > patience,
            }
            fault = fault or next((name for name, holds in faults.items() if holds), "")
            if stop(t) or fault or stopping:
                stopping += 1
                aim = None if stopping == 1 else aim  # it is to stay where it is
            if aim is None and np.isfinite(x).all():
                aim = x.copy()  # from where it is, so that the torque does not jump
            acting = held
            if fault or aim is None:  # nothing to steer to: gravity, damping and limits, whatever
                acting, x = controller, np.full_like(x, np.nan)  # was seen last and may be held
            own = slice(sizes[acting])  # the state of what is held comes first
            try:
                wanted, measured = goal(t) if aim is None else aim, aj.Measurement(t, q, v, x)
                # the period of the controllers, not the clock's
                state[own], answer = acting.step(state[own], measured, wanted, DT)
                torque, status, unknown = answer.torque, answer.status, 0
                limit, slack = answer.limit_status, answer.slack
            except MeasurementError:  # nothing may depend on q and q̇ now: the last torque once
                status, unknown = UNKNOWN, unknown + 1  # more, which no limit has to object to
            arm.send(torque)
            before, sent = sent, time.perf_counter()
            gap = sent - before
            theta_hat = controller.learnt(state[: len(inner)])
            did = t, gap, sent - began, status, limit, slack
            log[k % rows] = *did, q, v, x, wanted, torque, theta_hat

            blind = status == aj.Status.MEASUREMENT_LOST
            troubled = troubled + 1 if blind or limit >= aj.LimitStatus.PROOF_GIVEN_UP else 0
            if blind:
                aim = None  # from where it is seen again
            elif aim is not None and np.isfinite(x).all() and not stopping:  # else it waits
                aim = moved(task, aim, goal(t), speed * DT)
            if stopping:
                slowest = min(slowest, pace)
                over = faults["too fast"] or unknown > 10 or stopping * DT > 2.0
                # nothing holds the tip, and it was slower: a weight draws it down
                sinks = (fault or aim is None) and pace > slowest + 0.1
                if pace < 0.02 or over or sinks:
                    return fault or "asked to", np.roll(log, -k - 1)[-k - 1 :], theta_hat.copy()
            missed = math.ceil((sent - due) / DT)
            due += DT * max(1, missed)  # periods that are over are left out, not run in a burst
    finally:
        gc.enable()
        arm.brake()  # whatever happened


def require_held(controller, answer):
    """Refuse to begin where the limits do not hold the arm as it stands, as it is believed."""
    limits = getattr(controller, "limits", None)
    effort = np.inf if limits is None else np.asarray(limits.effort)
    gravity = answer.gravity
    if (np.abs(gravity) > effort).any() or answer.limit_status >= aj.LimitStatus.INFEASIBLE:
        raise ValueError(
            f"the limits do not hold the arm as it stands: gravity takes {gravity.round(1)}, the "
            f"limits are {effort}, and the limiter says: {answer.limit_status.message}"
        )


def wait_until(due):
    """Sleep for most of the time, as a sleep ends late; the rest passes in short ones."""
    while (left := due - time.perf_counter()) > 0.0:
        time.sleep(max(0.0, left - 2e-4))


def moved(task, aim, goal, step):
    """The target one step nearer to the goal, of any task: poses turn by it, too."""
    e = task.error(goal, aim)
    return task.displaced(aim, e * min(1.0, step / max(np.linalg.norm(e), 1e-9)))


def new_log(controller, state, rows):
    """A ring of rows that is there before the loop begins: nothing grows while it runs."""
    robot, n_x, p = controller.task.robot, controller.task.n_x, len(controller.learnt(state))
    nq, nv = robot.nq, robot.nv
    numbers = [(name, float) for name in ("t", "gap", "work")]
    numbers += [("status", int), ("limit", int), ("slack", float)]
    arrays = {"q": nq, "v": nv, "x": n_x, "target": n_x, "torque": nv, "theta_hat": p}
    return np.zeros(rows, numbers + [(name, float, (size,)) for name, size in arrays.items()])
