"""Reports of learnt kinematics."""

from typing import NamedTuple

from approxjac.validation import Array

_NOT_SEEN = 0.5  # resolved share of the prior variance below which a number counts as not learnt
SILENT = 1.0  # without a frame to learn from, after which it is said [s]
UNEXPLAINED = 1.5  # χ² a degree of freedom, above which x is not explained


class LearntNumber(NamedTuple):
    """One learnt number.

    Attributes:
        name: Name, such as "tool.x" or "camera.rz".
        unit: "m", "rad" or "px".
        believed: Value before the first frame.
        value: Learnt value.
        sd: Its standard deviation.
        share: Resolved share of the prior variance, 1 − P_ii/P0_ii.
    """

    name: str
    unit: str
    believed: float
    value: float
    sd: float
    share: float

    @property
    def is_seen(self) -> bool:
        """True if more than half of the prior variance was resolved."""
        return self.share >= _NOT_SEEN


class KinematicReport(NamedTuple):
    """A report of learnt kinematics.

    Attributes:
        rows: A row for each learnt number.
        covariance: Their covariance, in the same order, enlarged if χ² is above 1 or the noise
            above the given one. In short set-point runs with a camera in the hand, focal length
            and distance were off by 4 to 6 of their sd.
        angle: Angle of the camera's rotation [rad]; 0 if it is known.
        chi_squared: χ² per degree of freedom of residuals averaged over a third of a second: 1 if
            the unknown parameters explain x up to white noise.
        noise: Standard deviation of x, the given one and the observed one from frame to frame
            [`unit`].
        seconds: Time covered by the frames since the last restart [s].
        restarts: Number of times that learning restarted, as the sensor moved or the tool slipped.
        unit: Unit of the noise, "m" or "px".
        silence: Time since the last frame to learn from [s].
        last_joint: Joint from whose origin, and in whose link's axes, "tool" is measured.
    """

    rows: tuple[LearntNumber, ...]
    covariance: Array
    angle: float
    chi_squared: float
    noise: tuple[float, float]
    seconds: float
    restarts: int
    unit: str = "m"
    silence: float = 0.0
    last_joint: str = ""

    @property
    def is_explained(self) -> bool:
        """True if the unknown parameters explain the measured x."""
        return self.seconds > 0.0 and self.chi_squared <= UNEXPLAINED

    def __str__(self) -> str:
        width = max(len(row.name) for row in self.rows)
        head = f"{'':{width}}  {'believed':>10} {'learnt':>10} {'sd':>9} {'seen':>6}"
        since = f", restarted {self.restarts} times" if self.restarts else ""
        lines = [f"learnt from {self.seconds:.1f} s of frames{since}", head]
        for row in self.rows:
            said = f"{100.0 * row.share:5.0f} %" if row.is_seen else "not seen"
            numbers = f"{row.believed:10.4f} {row.value:10.4f} {row.sd:9.4f} {said:>8}"
            lines.append(f"{row.name:{width}}  {numbers} {row.unit}".rstrip())
        if self.last_joint and any(row.name == "tool.x" for row in self.rows):
            lines.append(f"tool: from the origin of {self.last_joint} to the tip, flange and all")
        if self.angle:
            lines.append(f"camera turned by {self.angle:.4f} rad")
        factor, unit = (1e3, "mm") if self.unit == "m" else (1.0, self.unit)
        given, seen = (factor * noise for noise in self.noise)
        lines.append(f"noise of x {seen:.2g} {unit}, assumed {given:.2g} {unit}")
        lines.append(f"chi squared per degree of freedom: {self.chi_squared:.2f}")
        if self.seconds == 0.0 or self.silence > SILENT:
            since = f"for the last {self.silence:.1f} s" if self.seconds else "yet"
            lines.append(f"no frame to learn from {since}: x is lost, or too old to tell q at it")
        if self.seconds and not self.is_explained:
            lines += ["the parameters that may be wrong do not explain x: others are (of a camera"]
            lines += ["also center and lens), or x is late"]
        return "\n".join(lines)
