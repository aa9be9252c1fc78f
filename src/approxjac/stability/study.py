"""`Study`: a controller with the errors that it may meet, and all that is asked of its loop."""

from __future__ import annotations

from approxjac.stability.search.map import stability_map
from approxjac.stability.search.suggested_gains import suggested_gains
from approxjac.stability.search.tolerance import tolerances
from approxjac.stability.studied_loop import StudiedLoop


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

    tolerance = tolerances
    map = stability_map
    gains = suggested_gains
