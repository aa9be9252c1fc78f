"""`Study`: a controller with the errors that it may meet, and all that is asked of its loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from approxjac.stability.rollouts.rollouts import Execution
from approxjac.stability.search.map import StabilityMap, map_of
from approxjac.stability.search.suggested_gains import Suggestion, suggested_gains
from approxjac.stability.search.tolerance import TESTS, Test, Tolerance, tolerances
from approxjac.stability.studied_loop import Progress, StudiedLoop, telling
from approxjac.validation import Array, as_integer


class Study(StudiedLoop):
    """A closed loop, the errors that it may meet, and where: what its tests have in common.

    Attributes:
        controller: The controller with its believed robot. Certificates are of law (6) or (28), and
            of `TorqueLimited` around it.
        uncertainty: How the true robot may differ. A report takes one true robot besides, as a
            `Plant`, or as a `Robot` on which the controller's own task is measured.
        region: Where starts, at rest, and targets are, as far as the true robot's sensor sees; the
            joint limits without near-singular configurations by default.
        target: x_d of all, shape (n_x,) [unit of the task], for rollouts also what moves; by
            default the values of other configurations of the region, so that answers are of all.
        latency: When the loop measures and acts; by default that of the controller, or 1 kHz with
            ideal sensors.
        sensing: How measurements of rollouts differ from the truth; by default as late as
            `latency` says, and exact.
        duration: Of a rollout, a whole number of periods [s]; about 10 by default.
        accuracy: > 0; a rollout converged if ‖e‖ is below it at every recorded instant of the last
            tenth [unit of the task]; by default 1 mm, 1 mrad or 0.5 px, or three times the sensor's
            noise if that is more.
        seed: Of all drawing, ≥ 0.

    Raises:
        InvalidInputError: Numbers out of range, or arguments of the wrong kind.

    Example:
        >>> arm = load_robot("two_link")
        >>> errors = Uncertainty(arm, object_length=(0.0, 0.2), object_axis="x")
        >>> law = SetpointController(errors.believed_task())
        >>> study = Study(law, errors, JointBox.around(arm, [0.5, 1.2], 0.4), duration=1.0)
        >>> study.rollouts(3).n
        3
    """

    def tolerance(
        self,
        tests: Sequence[Test] = TESTS,
        *,
        largest: float = 10.0,
        precision: float = 0.02,
        draws: int | None = None,
        progress: Progress = None,
    ) -> dict[Test, Tolerance]:
        """Find the largest scaling of the errors for which each test still passes.

        By bisection, with the same configurations at every scale. Functions are not checked in
        others, so a report may find a little less. A test might pass again beyond a gap.

        Args:
            tests: "theorem1", "matrix" (neither where Ĵ uses x), "local" or "rollouts".
            largest: Scale at most > 0; less where robots beyond it cannot exist.
            precision: Of the scale, relative, > 0.
            draws: Of configurations, 400 by default, or rollouts at each scale, 100 by default.
            progress: Called with "tolerance" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Numbers out of range, or what a report refuses.
            UnknownNameError: No such test.
        """
        with telling(progress) as tell:
            tell_share = partial(tell, "tolerance")
            return tolerances(self, tests, largest, precision, draws, tell_share)

    def map(
        self,
        over: Mapping[str, Sequence[float] | Array],
        n: int = 100,
        *,
        execution: Execution | None = None,
        progress: Progress = None,
    ) -> StabilityMap:
        """Carry out rollouts over a grid of one or two parameters.

        Each point has the same n runs, but for what was changed.

        Args:
            over: "error", "a", "kv" or "damping" (see `PARAMETERS`) → values: numbers that grow,
                > 0 of gains, ≥ 0 of "error".
            n: Runs at each point.
            execution: How and where they are carried out.
            progress: Called with "map" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Values that are no growing numbers, or what rollouts refuse.
            UnknownNameError: No such parameter.
        """
        n, execution = as_integer("n", n, 1), Execution() if execution is None else execution
        with telling(progress) as tell:
            return map_of(self, over, n, execution, partial(tell, "map"))

    def gains(
        self,
        settling_time: float = 1.0,
        *,
        test: Test = "matrix",
        torque_limits: float | Sequence[float] | Array | None = None,
        configurations: int = 200,
        progress: Progress = None,
    ) -> Suggestion:
        """Find gains of law (6) that pass a test, with gravity that is known exactly.

        Three demands: the test passes for every configuration drawn, and the sampled loop by a
        report or, of "local", by its exact linearisation; the torque of a start at rest, gravity
        compensated, is within the limits; and a small error settles to 2 % in the wanted time with
        every true robot: a far reach takes longer. Tried are multiples of the default gains, from
        gentle to strong, with K_p so that the believed arm settles in time.

        Args:
            settling_time: Wanted > 0 [s].
            test: The test to pass: "theorem1", "matrix" or "local".
            torque_limits: A number or shape (n_v,), infinite where there is none [N m or N]; the
                arm's effort limits by default.
            configurations: How many to draw.
            progress: Called with "gains" and the share that is done; True shows a bar.

        Raises:
            InvalidInputError: Numbers out of range, or an empty region.
            UnknownNameError: No such test.
        """
        with telling(progress) as tell:
            limits, tell_share = torque_limits, partial(tell, "gains")
            return suggested_gains(self, settling_time, test, limits, configurations, tell_share)
