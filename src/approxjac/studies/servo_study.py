"""Visual servoing from many starts: what must be shown, and the laws compared on the same starts.

The arm holds an object that its controller believes absent, and every number of the camera is
believed wrong, with signs that are drawn for each start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.controllers.tuning import position_gains
from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.studies import servo
from approxjac.studies.processes import run_in_processes
from approxjac.studies.servo_settings import ServoSettings
from approxjac.validation import Array

ROLL, FOCAL, DEPTH = math.radians(30.0), 0.3, 0.5  # how wrong the believed camera is
NOISES = (0.0, 0.5, 2.0)  # of the comparison [px]
_USUAL_NOISE = ServoSettings().noise
_MOST_SEEDS = 3  # as many seeds as starts are wanted, before it is given up


class Law(NamedTuple):
    """A law of the comparison.

    Attributes:
        law: As in `ServoSettings`.
        differentiator: Time constant of law (5) [s].
        gains: Name of the law whose default gains it gets; its own by default.
        damping: Name of the law whose B_c it gets, with the K_p that the default rule has for it.
    """

    law: Literal["6", "5", "ibvs"]
    differentiator: float = 0.1
    gains: str | None = None
    damping: str | None = None


LAWS = {
    "law 6": Law("6"),
    "law 5, 0.03 s": Law("5", 0.03),
    "law 5, 0.1 s": Law("5", 0.1),
    "law 5, 0.3 s": Law("5", 0.3),
    "law 5, 0.1 s, B_c of law 6": Law("5", 0.1, damping="law 6"),
    "law 5, 0.1 s, gains of law 6": Law("5", 0.1, gains="law 6"),
    "law 6, gains of law 5, 0.1 s": Law("6", gains="law 5, 0.1 s"),
    "IBVS": Law("ibvs"),
}
"""The laws that are compared, by name; a name says whose gains a law has, if not its own."""


class Setting(NamedTuple):
    """An arm and what is seen of it.

    Attributes:
        robot: The arm.
        settings: What is not as by default.
        laws: Names of the laws that are compared there.
        noises: Standard deviations of the noise with which they are [px].
    """

    robot: str
    settings: ServoSettings
    laws: tuple[str, ...]
    noises: tuple[float, ...]


ONE_POINT = "panda, one point"
WITHIN_LIMITS = "panda, one point, limits kept"
SCENES = {
    ONE_POINT: Setting("panda", ServoSettings(), tuple(LAWS), NOISES),
    WITHIN_LIMITS: Setting("panda", ServoSettings(torque_limits="urdf"), (), ()),
    "panda, two points": Setting(
        "panda", ServoSettings(points=2), ("law 6", "IBVS"), (_USUAL_NOISE,)
    ),
    "ur5, camera in hand, two points": Setting(
        "ur5",
        ServoSettings(eye="in-hand", points=2, object_length=0.0, object_mass=0.0),
        ("law 6", "IBVS"),
        (_USUAL_NOISE,),
    ),
}
"""Where laws are compared, by name."""


class Case(NamedTuple):
    """One run: where, with which law, noise [px] and gravity, and the seed of all that is drawn."""

    scene: str
    law: str
    noise: float
    gravity: Literal["exact", "learnt"]
    seed: int


class Outcome(NamedTuple):
    """What became of one run; the fields of `ServoResult`.

    Attributes:
        case: The case.
        start_error: Largest distance of a point from its target at the start [px].
        final_error: RMS of the worst coordinate's true error at the end [px]; infinite without one.
        settling_time: From when on all points stay within three tolerances [s]; NaN if never.
        peak_torque: Largest torque that was asked for, as a share of its limit.
        roughness: RMS change of torques from record to record at the end [N m].
        converged: Whether that is within the noise (half a pixel without noise).
        in_view: Whether all points were in view throughout; true where a run has no record, so
            that it counts.
        left_at: When a point first left the view [s]; NaN if none did.
        reason: What kept the task from being done.
    """

    case: Case
    start_error: float = math.nan
    final_error: float = math.inf
    settling_time: float = math.nan
    peak_torque: float = math.nan
    roughness: float = math.nan
    converged: bool = False
    in_view: bool = True
    left_at: float = math.nan
    reason: str = ""


def wrong_camera(settings: ServoSettings, seed: int) -> ServoSettings:
    """Settings with roll, focal length and depth wrong by what is asked, with drawn signs."""
    signs = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], 3).tolist()
    return replace(
        settings,
        roll=signs[0] * ROLL,
        focal_factor=1.0 + signs[1] * FOCAL,
        depth_factor=1.0 + signs[2] * DEPTH,
        seed=seed,
    )


def settings_of(case: Case) -> ServoSettings:
    """What is simulated for a case.

    Raises:
        ApproxJacError: No start was found for the seed.
    """
    scene, law = SCENES[case.scene], LAWS[case.law]
    settings = replace(
        wrong_camera(scene.settings, case.seed), noise=case.noise, gravity=case.gravity
    )

    def with_law(law: Law) -> ServoSettings:
        return replace(settings, law=law.law, differentiator=law.differentiator)

    def gains_of(law: Law) -> tuple[SetpointController, Array, Array, Array]:
        controller = servo.prepare(scene.robot, with_law(law)).controller
        if not isinstance(controller, SetpointController):
            raise InvalidInputError(f"gains must be those of law 5 or 6, got {law}", given=law)
        task = controller.task
        return controller, *controller.gains.diagonals(task.m, task.robot.nv)

    if law.gains is not None:
        _, kp, kv, damping = gains_of(LAWS[law.gains])
    elif law.damping is not None:
        controller, _, kv, _ = gains_of(law)
        damping = gains_of(LAWS[law.damping])[3]
        kp = position_gains(controller.task, kv, damping, settings.settling_time)
    else:
        return with_law(law)
    return replace(
        with_law(law),
        kp=tuple(kp.tolist()),
        kv=tuple(kv.tolist()),
        damping=tuple(damping.tolist()),
    )


def run_case(case: Case) -> Outcome:
    """Run one case at 1 kHz, with motors that saturate; what cannot run is an outcome too."""
    try:
        result = servo.run(servo.prepare(SCENES[case.scene].robot, settings_of(case)))
    except ApproxJacError as error:
        return Outcome(case, reason=f"{error}")
    unseen = result.unseen
    return Outcome(
        case,
        start_error=float(result.errors[0].max()),
        final_error=result.final_error,
        settling_time=result.settling_time,
        peak_torque=result.peak_torque_ratio,
        roughness=result.torque_roughness,
        converged=result.converged,
        in_view=result.stays_in_view,
        left_at=float(result.run.t[unseen.argmax()]) if unseen.any() else math.nan,
        reason=result.reason,
    )


def require_starts(starts: int) -> int:
    """Refuse no starts.

    Raises:
        InvalidInputError: Less than one.
    """
    if starts < 1:
        raise InvalidInputError(f"starts must be at least 1, got {starts}", given=starts)
    return starts


def must_show(
    starts: int,
    jobs: int | None = None,
    progress: Callable[[], None] | None = None,
    scene: str = ONE_POINT,
) -> list[Outcome]:
    """Run law (6) from seed after seed, until enough paths stayed in view.

    Gravity is exact for even seeds and learnt for odd ones. It ends without enough of them after
    three times as many seeds.

    Args:
        starts: How many paths have to stay in view.
        jobs: Processes; as many as there are processors by default.
        progress: Called after each run.
        scene: `ONE_POINT`, or `WITHIN_LIMITS` where the URDF's limits are known and kept.

    Raises:
        InvalidInputError: No starts.
    """
    starts = require_starts(starts)
    outcomes: list[Outcome] = []
    while len(outcomes) < _MOST_SEEDS * starts:
        missing = starts - sum(outcome.in_view for outcome in outcomes)
        if missing == 0:
            break
        cases = [
            Case(scene, "law 6", _USUAL_NOISE, "learnt" if seed % 2 else "exact", seed)
            for seed in range(len(outcomes), len(outcomes) + missing)
        ]
        outcomes += run_in_processes(run_case, cases, jobs, progress)
    return outcomes


def cases(starts: int) -> list[Case]:
    """Return the cases of the comparison: each law and noise from the same starts, scene by scene.

    Gravity is exact, as the velocity servo cannot learn it.

    Raises:
        InvalidInputError: A negative number of starts.
    """
    if starts < 0:
        raise InvalidInputError(f"comparisons must be at least 0, got {starts}", given=starts)
    return [
        Case(name, law, noise, "exact", seed)
        for name, scene in SCENES.items()
        for noise in scene.noises
        for law in scene.laws
        for seed in range(starts)
    ]


def compare(
    cases: Sequence[Case], jobs: int | None = None, progress: Callable[[], None] | None = None
) -> list[Outcome]:
    """Run cases in several processes, and return their outcomes in the order of the cases."""
    return run_in_processes(run_case, cases, jobs, progress)
