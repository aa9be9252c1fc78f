"""`Transmission`: rotors, elastic gears and dry friction between motors and links, step by step."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.law.factors import Factors
from approxjac.robots import Robot
from approxjac.robots.drives import Drives, Friction, usual_inertia
from approxjac.validation import Array

_GUESSES = 3, 6  # which joints slide: where all are elastic they hardly feel each other


class Motors(NamedTuple):
    """State of real joints beside (q, v), shape (n_v,) each.

    Of rigid joints `twist` is 0 and `rate` q̇.
    """

    twist: Array  # θ − q [rad or m]
    rate: Array  # θ̇ [rad/s or m/s]
    held: Array  # impulse of dry friction in the last step, where the search begins [N m s or N s]
    change: Array  # of q̇ in the last step, for Coriolis forces in the middle of the next


class JointStep(NamedTuple):
    """Result of a step, and its answer to a further impulse on the links."""

    v: Array  # q̇ of the links after it, (n_v,)
    motors: Motors
    M_inv: Array  # change of v by a unit impulse on each link, (n_v, n_v)


class Transmission:
    """Steps of an arm whose motors have rotors, elastic gears, and friction that sticks.

    The midpoint rule in springs and dampers, implicit Euler in friction: no stiffness is too stiff
    and no friction too high for a step. What is unknown is eliminated down to an n_v × n_v matrix.
    """

    def __init__(self, robot: Robot, friction: Friction, drives: Drives) -> None:
        self._robot, self.friction, self.drives = robot, friction, drives
        stiffness = np.asarray(drives.stiffness)
        self.is_rigid = ~np.isfinite(stiffness)
        self._K = np.where(self.is_rigid, 0.0, stiffness)
        self.is_dry = bool(np.any(friction.coulomb) or np.any(friction.load))
        self.is_elastic = not self.is_rigid.all()
        # motors are more than the torques on their links
        self.moves = self.is_elastic or bool(np.any(drives.rotor_inertia) or np.any(drives.ripple))
        self.is_ideal = not (self.is_dry or self.moves)
        self._guesses = _GUESSES[int(self.is_rigid.any())]

    @cached_property
    def _usual(self) -> Array:
        return usual_inertia(self._robot)

    @cached_property
    def damping(self) -> Array:
        """D, shape (n_v,) [N m s/rad or N s/m]."""
        return self.drives.damping(usual_inertia(self._robot, held=True))

    def at_rest(self, carried: Array) -> Motors:
        """Return the motors of an arm at rest whose gears carry some torques (n_v,)."""
        nothing, K = np.zeros(len(carried)), np.where(self.is_rigid, 1.0, self._K)
        bent = carried / K + self.drives.backlash * np.sign(carried)
        return Motors(np.where(self.is_rigid, 0.0, bent), nothing, nothing, nothing)

    def step(
        self,
        v: Array,
        motors: Motors,
        tau: Array,
        h: float,
        terms: tuple[Array, Array],
        angle: Array | None = None,
    ) -> JointStep:
        """Advance by one step h [s], on numbers or symbols.

        Args:
            v: q̇ of the links (n_v,).
            motors: The motors.
            tau: Torques of the motors (n_v,).
            h: Step [s].
            terms: M (n_v, n_v) and the bias C q̇ + g (n_v,) of the links, half a step ahead.
            angle: Motion of the links from neutral (n_v,), for `ripple`.
        """
        (M, bias), drives, rigid = terms, self.drives, self.is_rigid
        B, (twist, w, held, _) = np.asarray(self.friction.viscous), motors
        w = np.where(rigid, v, w)
        if angle is not None and np.any(drives.ripple):
            tau = tau + drives.ripple * np.sin(drives.ripple_count * (angle + twist))
        K: Any = self._K
        D: Any = self.damping if self.is_elastic else K
        bend = twist
        if np.any(drives.backlash):
            mid = twist + 0.5 * h * (w - v)
            free = np.where(mid > 0.0, 1.0, -1.0) * np.asarray(drives.backlash)
            meshed = np.abs(mid) > np.abs(free)
            K, D, bend = np.where(meshed, K, 0.0), np.where(meshed, D, 0.0), twist - free
        spring = K * bend + (0.5 * h * K + D) * (w - v)  # at the middle, if the rates stayed
        stiff = h * (0.25 * h * K + 0.5 * D)
        J = np.asarray(drives.rotor_inertia)
        # of viscous friction half is that at the step's end, more where it stops a joint
        stopped = 1.0 - (J + np.where(rigid, self._usual, 0.0)) / np.maximum(h * B, 1e-300)
        J = J + np.maximum(0.5, stopped) * h * B
        whole = np.where(rigid, 1.0, J + stiff)  # of a rotor with its spring; not of rigid joints
        share = np.where(rigid, 1.0, stiff / whole)  # of a change of θ̇ that q̇ takes along
        mobility = np.where(rigid, 0.0, 1.0 / whole)
        drive = tau - B * w
        S = _solved(M + np.diag(share * J), np.eye(len(v)))
        dv = S @ (h * ((1.0 - share) * spring + share * drive - bias))
        w_end = w + mobility * h * (drive - spring) + share * dv
        if self.is_dry:
            load = np.abs(np.where(rigid, bias, spring))
            most = h * (self._coulomb(w) + np.asarray(self.friction.load) * load)
            W = np.diag(mobility) + share[:, np.newaxis] * S * share
            held, w_end = _sticking(W, w_end, most, held, self._guesses)
            dv = dv - S @ (share * held)
        v_end = np.where(rigid, w_end, v + dv)
        turned = twist + 0.5 * h * (w + w_end - v - v_end)
        return JointStep(v_end, Motors(np.where(rigid, 0.0, turned), w_end, held, v_end - v), S)

    def pushed(self, after: JointStep, impulse: Array) -> JointStep:
        """Return a step with a further impulse (n_v,) on the links, as of stops [N m s or N s]."""
        v, motors, S = after
        dv, w = S @ impulse, motors.rate
        w = np.where(self.is_rigid, w + dv, w)
        return JointStep(v + dv, motors._replace(rate=w, change=motors.change + dv), S)

    def _coulomb(self, w: Array) -> Array:
        F = np.asarray(self.friction.coulomb)
        if self.friction.stribeck == 1.0:
            return F
        more = self.friction.stribeck - 1.0
        return F * (1.0 + more * np.exp(-np.abs(w) / self.friction.stribeck_velocity))


def _solved(A: Array, b: Array) -> Array:
    """Return A⁻¹b of a symmetric A, of numbers or symbols."""
    return Factors(A).solve(b) if A.dtype.hasobject else np.asarray(np.linalg.solve(A, b))


def _sticking(W: Array, free: Array, most: Array, held: Array, guesses: int) -> tuple[Array, Array]:
    """Return impulses |p| ≤ most that stop joints or brake those that slide, and their rates.

    Rates are free − W p, W (n_v, n_v) positive definite. Which joints slide, and where to, is found
    in a few guesses (Newton's method), from the impulses `held` (n_v,) of the step before.
    """
    eye = np.eye(len(free))
    on = np.where(held >= most, 1.0, np.where(held <= -most, -1.0, 0.0))

    def guess(_: Any, values: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        on, *_ = values
        stands = on == 0.0
        braked = on * most
        A = np.where(stands[:, np.newaxis] & stands, W, eye)
        p = _solved(A, np.where(stands, free - W @ braked, braked))
        w = np.where(stands, 0.0, free - W @ p)
        slips = np.where(p > most, 1.0, np.where(p < -most, -1.0, 0.0))
        return np.where(stands, slips, np.where(on * w < 0.0, 0.0, on)), p, w

    values = on, held, free
    if hasattr(free, "looped"):  # on symbols
        values = law.repeat(guesses, guess, values)
    else:
        for i in range(guesses):
            before, values = values[0], guess(i, values)
            if (values[0] == before).all():
                break
    _, p, w = values
    return np.minimum(np.maximum(p, -most), most), w
