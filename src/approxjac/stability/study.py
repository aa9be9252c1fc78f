"""`Study`: a controller with possible errors, and all tests of its loop."""

from approxjac.stability.search.map import stability_map
from approxjac.stability.search.suggested_gains import suggested_gains
from approxjac.stability.search.tolerance import tolerances
from approxjac.stability.studied_loop import StudiedLoop


class Study(StudiedLoop):
    """A closed loop, a set of model errors and a region, for all stability tests.

    Attributes:
        controller: The controller with its believed robot. Certificates are for law (6) or (28),
            also inside `TorqueLimited`.
        uncertainty: Set of true robots. A report also takes a single true robot, as a `Plant`, or
            as a `Robot` on which the controller's own task is measured.
        region: Region of starts (at rest) and targets, as far as the true robot's sensor sees
            them; by default the joint limits without near-singular configurations.
        target: x_d of all tests, shape (n_x,) [unit of the task], or a moving one of rollouts; by
            default targets are the values of configurations of the region.
        latency: Latency of the loop; by default the controller's, or 1 kHz with ideal sensors.
        sensing: Sensor errors of rollouts; by default none but the delays of `latency`.
        duration: Duration of a rollout, a whole number of periods [s]; about 10 by default.
        accuracy: > 0; a rollout converged if ‖e‖ is below it at every recorded instant of the last
            tenth [unit of the task]; by default 1 mm, 1 mrad or 0.5 px, or three times the sensor's
            noise if that is more.
        seed: Seed of all random draws, ≥ 0.

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

    tolerance = tolerances
    map = stability_map
    gains = suggested_gains
