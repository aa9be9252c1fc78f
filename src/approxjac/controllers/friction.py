"""`FrictionCompensation`: a torque against dry friction that turns with the error."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.formatting import short_fields
from approxjac.robots import Friction, Robot
from approxjac.robots.drives import usual_effort
from approxjac.tasks import Task
from approxjac.tasks.analysis import FINE
from approxjac.validation import Array, as_diagonal, as_number, require

_FINE = 0.2  # of the error that counts as none
_STEPS = 1.5  # of the encoders, at the tip
FRICTION_SHARE = 0.8  # of the given Coulomb friction: too much would act as a relay
_MOST = 0.25  # of the motors' effort
_RATE = 0.3  # of F_max that F̂ grows by in a second
_SHARP = 0.2  # of the widest ε of all joints, which each has at least
_STANDS, _LAGS = (1e-3, 0.05), (1.0, 0.3)  # slower than that [rad/s or m/s], and share of ν
_FALLS = 5.0  # times the added damping [1/s]


@dataclass(frozen=True, eq=False, repr=False)
class FrictionCompensation:
    """The torque F̂ tanh(ν/ε) against dry friction, with ν = −αĴ⁺s(e) and a learnt F̂.

    ν is the joint velocity that the law wants (y = q̇ − ν of (10)). The torque turns with the error
    at once, where an integral would have to unwind: the joints do not hunt. F̂ grows only at joints
    that stand though they should move, and falls where one moves ahead of ν. While all joints
    stand, gravity is not learnt: what stands tells of friction. Within half of `fine` of the target
    all learning rests (`Status.HOLDING`) until all of it is exceeded.

    x has to be as recent as q: with a late sensor, use it within a `PredictedMeasurement`.

    Attributes:
        known: Friction of the joints, of whose Coulomb part F̂ begins with 0.8; None is not known.
        fine: Error of each coordinate that is not reduced further, a number or (m,) [unit of the
            task]; by default 0.2 mm, 0.2 mrad and 0.1 px, and 1.5 steps of the encoders at least.
        encoder_step: Step of the encoders ≥ 0 [rad or m].
        most: Largest F̂, a number or shape (n_v,) [N m or N]; a quarter of the efforts by default.

    Raises:
        InvalidInputError: Numbers that are not positive, or of another kind.
    """

    known: Friction | None = None
    fine: float | Sequence[float] | Array | None = None
    encoder_step: float = 0.0
    most: float | Sequence[float] | Array | None = None
    __repr__ = short_fields

    def parameters(self, robot: Robot) -> dict[str, str]:
        """Return names and units of F̂."""
        joints = zip(robot.joint_names, robot.force_units, strict=True)
        return {f"friction of {name}": unit for name, unit in joints}

    def rule(
        self, task: Task, gains: Diagonals, alpha: float, weight: Array | None, learns: bool
    ) -> law.Rubbing:
        """Return the numbers of the rule for a task, its gains, α [1/s] and the weight of Ĵ⁺."""
        robot, nv = task.robot, task.robot.nv
        J_hat = sample_configurations(task).J_hat
        if self.fine is None:
            step = as_number("encoder_step", self.encoder_step, unit="rad or m", minimum=0.0)
            fine = _STEPS * step * np.linalg.norm(J_hat, axis=2).max(axis=0)
            fine = np.maximum(fine, [_FINE * FINE.get(unit, FINE["m"]) for unit in task.units])
        else:
            fine = as_diagonal("fine", self.fine, task.m)
        effort = usual_effort(robot)
        most = _MOST * effort if self.most is None else as_diagonal("most", self.most, nv)
        root = np.ones(nv) if weight is None else np.sqrt(weight)
        pinv = np.linalg.pinv(J_hat / root) / root[:, np.newaxis]
        width = alpha * np.median(np.linalg.norm(pinv * fine, axis=-1), axis=0)
        width = np.maximum(width, _SHARP * width.max())
        first = np.zeros(nv)
        if self.known is not None:
            known = require("known", self.known, Friction, "Friction(...) or None").of(nv)
            first = np.minimum(FRICTION_SHARE * np.asarray(known.coulomb), most)
        stands = _STANDS if learns else _LAGS
        falls = _FALLS * gains.damping
        return law.Rubbing(width, most, _RATE * most, falls, 0.5 * fine, first, *stands)
