"""Gravity parameters that a motion tells apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.robots.gravity_regressor import GravityRegressor
from approxjac.validation import Array, as_array, as_number, require, shape_of


@dataclass(frozen=True, eq=False, repr=False)
class Excitation:
    """Report of which parameters θ of g = Z(q)θ the configurations of a motion tell apart.

    Attributes:
        names: Names of the parameters, length p.
        effect: Root mean square of the torque that one unit of a parameter makes, shape (p,)
            [N m per unit].
        own: What of it no combination of the other parameters can make, shape (p,) [N m per unit].
            Where it is 0, learning cannot tell the parameter from others on this motion.
        threshold: Share of `effect` that `own` has to reach for a parameter to count as excited.
        rank: Number of combinations of parameters that the motion excites.
    """

    names: tuple[str, ...]
    effect: Array
    own: Array
    threshold: float
    rank: int

    @property
    def excited(self) -> tuple[str, ...]:
        """Parameters that the motion determines by themselves."""
        large = (self.effect > 0.0) & (self.own >= self.threshold * self.effect)
        return tuple(name for name, is_large in zip(self.names, large, strict=True) if is_large)

    def __repr__(self) -> str:
        width, excited = max(len(name) for name in self.names), self.excited
        lines = [
            f"  {name:{width}}  {effect:9.3g}  {own:9.3g}  {'yes' if name in excited else 'no'}"
            for name, effect, own in zip(self.names, self.effect, self.own, strict=True)
        ]
        lines[:0] = [
            f"Excitation: {self.rank} of {len(self.names)} combinations",
            f"  {'':{width}}  {'effect':>9}  {'own':>9}  excited   [N m per unit]",
        ]
        return "\n".join(lines)


def excitation(regressor: GravityRegressor, q: Array, threshold: float = 0.05) -> Excitation:
    """Report which gravity parameters a motion excites, such as `run.q`.

    Learnt gravity (29) needs no excitation to bring the task to its target; θ̂ reaches θ only
    along what is excited.

    Args:
        regressor: The regressor.
        q: Configurations of the motion, shape (N, nq) [rad or m].
        threshold: Share of a parameter's effect that must be its own, from 0 to 1.

    Raises:
        InvalidInputError: Wrong shapes or not finite, no configuration, or a threshold out of
            range.
    """
    require("regressor", regressor, GravityRegressor, "a GravityRegressor")
    robot = regressor.robot
    size = robot.nv if shape_of(q)[1:] == (robot.nv,) else robot.nq  # or angles of the joints
    q = as_array("q", q, ("N", size), "rad or m")
    threshold = as_number("threshold", threshold, above=0.0)
    if threshold > 1.0:
        raise InvalidInputError(f"threshold must be at most 1, got {threshold:g}", given=threshold)
    Z = np.vstack([regressor.Z(each) for each in q]) / np.sqrt(len(q))
    effect = np.linalg.norm(Z, axis=0)
    effect[effect < 1e-12 * effect.max()] = 0.0  # round-off
    A = np.divide(Z, effect, out=np.zeros_like(Z), where=effect > 0.0)
    A_plus = np.linalg.pinv(A, rcond=1e-6)
    # 1/(A⁺A⁺ᵀ)ₖₖ is the squared distance of column k to the span of the others; a parameter with a
    # share in the null space has none
    alone = 1.0 - np.einsum("ij,ji->i", A_plus, A) < 1e-6
    own = np.divide(effect, np.linalg.norm(A_plus, axis=1), out=np.zeros_like(effect), where=alone)
    rank = int(np.linalg.matrix_rank(A, tol=threshold))
    return Excitation(regressor.names, effect, own, threshold, rank)
