"""The tracking law: motion that follows a target, its derivative, and the torque for it.

Not of the paper: J.-J. E. Slotine and W. Li, "On the adaptive control of robot manipulators", Int.
J. Robotics Research 6(3), 1987, on an error that kinematics predict. Shapes: z, u, ẋ_d are (m,), Ĵ
is (m, n_v), q̇, q̇_r, q̈_r, σ, n₀ are (n_v,).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import (
    all_finite,
    any_of,
    array,
    choose,
    complement,
    is_finite,
    select,
)
from approxjac.law.products import root
from approxjac.law.pseudoinverse import (
    SINGULAR_RATIO,
    damped_solver,
    damping_rate,
    is_near_singular,
    regular_solver,
)
from approxjac.validation import Array


class PredictedError(NamedTuple):
    """The error predicted by estimates at one instant, with the terms of its derivatives.

    It is in the base frame, into which the target is transformed. With Ĉ = R̂ᵀ/ŝ and ĉ = −Ĉb̂ of a
    camera or tracker x = sRp + b (Ĉ = I if it is known), z = p̂(q) − (Ĉx_d + ĉ) and, exactly,
    ż = Ĵq̇ − x_d_dot + drift. It is in the task's unit if the sensor measures in metres.

    Attributes:
        z: Predicted error, shape (m,).
        J: Ĵ, the exact Jacobian of the prediction, shape (m, n_v).
        J_dot: dĴ/dt along q̇ and the motion of the estimates, shape (m, n_v).
        x_d_dot: Ĉẋ_d, shape (m,).
        x_d_ddot: Its rate Ĉẍ_d + Ĉ'ẋ_d, shape (m,).
        drift: Velocity of z due to the estimates, ż − Ĵq̇ + x_d_dot, shape (m,).
    """

    z: Array
    J: Array
    J_dot: Array
    x_d_dot: Array
    x_d_ddot: Array
    drift: Array


_ZERO, _ONE = np.array(0.0), np.array(1.0)  # as arrays, which NumPy takes sooner than numbers
_OUTSIDE = 1.001  # zones from an end, where nothing is rounded to be in one
_PASSES = 2  # in which shares are found
_CREEPS = 0.2  # of the speed that counts as one towards an end: what is left of it at the end
_FREELY, _FULL = 0.5, 0.8  # shares of largest speeds, between which `TeachingMotion` slows down
_AWAY = 2.0  # times the ratio of a singular Ĵ, below which it stops
_FOLLOWS = 0.3  # time that it takes to [s]


class StopZones(NamedTuple):
    """Ranges of joints, near whose ends a reference leaves motion to the others; (n_v,) each."""

    low: Array
    high: Array
    zone: Array  # δ, in front of each end
    slow: Array  # v₀, above which a speed towards it counts
    free: tuple[list[float], list[float]]  # positions between which each joint is in none

    @classmethod
    def of(cls, low: Array, high: Array, zone: Array, slow: Array) -> StopZones:
        """Return those of ranges (n_v,) with zones δ."""
        free = low + _OUTSIDE * zone, high - _OUTSIDE * zone
        return cls(low, high, zone, slow, (free[0].tolist(), free[1].tolist()))

    def are_far(self, motion: Array, v_r: Array) -> bool:
        """Return True if surely no joint moves towards an end that is near, at a motion (n_v,)."""
        if motion.dtype.hasobject:
            return False
        each = zip(motion.tolist(), v_r.tolist(), *self.free, strict=True)
        return all((low < q or v > 0.0) and (q < high or v < 0.0) for q, v, low, high in each)

    def near(self, motion: Array) -> tuple[Array, Array]:
        """Return the depth of joints in their zones, with its sign, at a motion (n_v,)."""
        low, high = (self.low - motion) / self.zone + _ONE, (motion - self.high) / self.zone + _ONE
        return np.maximum(np.maximum(low, high), _ZERO), np.copysign(_ONE, high - low)


def smaller_share(
    r: Any, r_dot: Any, near: Any, side: Any, v: Any, v_r: Any, a_r: Any, zone: Any, slow: Any
) -> tuple[Any, Any]:
    """Return a joint's share r in a motion, less of it towards an end of `StopZones`; and its rate.

    r ← r (1 − c²(3 − 2c) s²/(1 + s²)), with c from 0 to 1 on the way through the zone, and s the
    reference's speed towards the end, over v₀, which falls to a fifth of it at the end.
    """
    c, c_dot = select(near < 1.0, near, 1.0), side * v / zone
    c_dot = select(near < 1.0, c_dot, 0.0)
    per = 1.0 / (slow * (1.0 - (1.0 - _CREEPS) * c))
    s = side * v_r * per
    s = select(s > 0.0, s, 0.0)
    s_dot = (side * a_r + s * slow * (1.0 - _CREEPS) * c_dot) * per
    s_dot, more = select(s > 0.0, s_dot, 0.0), 1.0 + s * s
    depth, speed = c * c * (3.0 - 2.0 * c), s * s / more
    depth_dot, speed_dot = 6.0 * c * (1.0 - c) * c_dot, 2.0 * s * s_dot / (more * more)
    less, less_dot = 1.0 - depth * speed, -(depth_dot * speed + depth * speed_dot)
    return r * less, r_dot * less + r * less_dot


class TeachingMotion(NamedTuple):
    """A self-motion n that shows an estimator what the task's motion does not.

    It follows wanted speeds by ṅ = (n_w − n)/T, so that its rate is exact whatever n_w is: a sine
    for each joint. These are zero for joints in front of a stop, towards it. All are less where a
    joint nears its largest speed, and zero near a singular Ĵ, or while the target rests.

    Its memory are the time that it has moved for, and n.
    """

    size: float  # of n_w [rad/s or m/s]
    omega: Array  # [rad/s]
    phase: Array  # [rad]
    stops: StopZones
    fastest: Array  # [rad/s or m/s]
    ratio: float  # of σ_max, below which Ĵ is singular
    dt: float

    def step(
        self, memory: Array, J: Array, motion: Array, v: Array, rests: Any
    ) -> tuple[Array, Array]:
        """Return the memory a period later, and ṅ now, at positions `motion` (n_v,)."""
        time, n = memory[0], memory[1:]
        near, sides = self.stops.near(motion)
        wanted = self.size * np.sin(self.omega * time + self.phase)
        wanted = np.where((near > 0.0) & (sides * wanted > 0.0), 0.0, wanted)
        room = (_FULL - (np.abs(v) / self.fastest).max()) / (_FULL - _FREELY)
        room = np.minimum(np.maximum(room, 0.0), 1.0)
        stays = rests | is_near_singular(J.dot(J.T), _AWAY * self.ratio)
        rate = (select(stays, 0.0 * room, room) * wanted - n) / _FOLLOWS
        after = select(rests, time, time + self.dt)
        return np.concatenate([array([after]), n + self.dt * rate]), rate


class ReferenceGains(NamedTuple):
    """Gains of a reference that brings an error to zero."""

    alpha: float | Array  # α and 1/vᵢ of `task_velocity`
    per_speed: float | Array
    fastest: Array  # speeds of joints of `within_speeds`
    singular_ratio: float = SINGULAR_RATIO  # and scale, of `damped_gram_solve`
    scale: float = 0.0
    stops: StopZones | None = None
    shares: Array | None = None  # constant shares r > 0 of joints in the motion, (n_v,)
    alpha_dot: Any = None  # rate of α, None of a constant one
    beside: tuple[Array, Array] | None = None  # w and its rate, taken off u, (m,) each


def saturated(z: Array, z_dot: Array, k: float | Array) -> tuple[Array, Array]:
    """Return s(z) = z/√r with r = 1 + Σ(kᵢzᵢ)², and its derivative (ż − z Σkᵢ²zᵢżᵢ/r)/√r.

    s is along z, and with k = 1/v no sᵢ(z) is above vᵢ; with one v for all, ‖s(z)‖ is not.
    """
    u = k * z
    r = 1.0 + u.dot(u)
    size = root(r)
    return z / size, (z_dot - z * (u.dot(k * z_dot) / r)) / size


def task_velocity(
    z: Array,
    z_dot: Array,
    x_d_dot: Array,
    x_d_ddot: Array,
    alpha: float | Array,
    per_speed: float | Array,
    alpha_dot: Any = None,
) -> tuple[Array, Array]:
    """Return u = ẋ_d − s(αz) and its derivative, with ẋ_d, ẍ_d, the k of `saturated` and α's rate.

    None is the rate of a constant α.
    """
    y_dot = alpha * z_dot if alpha_dot is None else alpha * z_dot + alpha_dot * z
    s, s_dot = saturated(alpha * z, y_dot, per_speed)
    return x_d_dot - s, x_d_ddot - s_dot


class EasedTarget(NamedTuple):
    """A target that is led to the real one as a critically damped oscillator, from the first x.

    With d = x_r − x_d, ẍ_r = ẍ_d − 2ω(ḋ + s(½ωd)), s of `saturated`, and an ω that is twice the
    law's α, or at least `slowest`. A law that follows it with the torques that M̂ẍ_r asks for gets
    to a target that jumps, or moves off, sooner than its gains could bring it there, and nothing
    that is measured enters it: no gain is higher.

    Its memory are x_r, ẋ_r, and whether an x was seen, for an error that is x − x_d.
    """

    slowest: float  # [1/s]
    per_speed: Array  # 1/vᵢ, (m,)
    dt: float

    def start(self, x_hat: Array, velocity: Array) -> Array:
        """Return the memory before the first step, with x and ẋ as believed, (m,) each."""
        return np.concatenate([x_hat, velocity, np.zeros_like(x_hat, shape=1)])

    def step(
        self,
        memory: Array,
        x: Array,
        target: tuple[Array, Array, Array],
        alpha: Any,
        waits: Any = False,
    ) -> tuple[Array, tuple[Array, Array, Array]]:
        """Return the memory a period later, and x_r, ẋ_r and ẍ_r now, for x_d, ẋ_d and ẍ_d.

        It begins at the first x that is seen, if that is within two seconds of motion of what is
        believed, and rests while the law `waits` for a prediction.
        """
        m, (goal, goal_v, goal_a) = len(x), target
        known, seen, place = is_finite(x), memory[-1] > 0.0, memory[:m]
        far = np.minimum(np.abs(self.per_speed * (x - place)), 2.0)
        is_near = known & (far.dot(far) < 4.0)
        place = select(seen, place, select(is_near, x, place))
        velocity = select(waits, 0.0 * goal_v, memory[m:-1])
        omega = select(2.0 * alpha > self.slowest, 2.0 * alpha, 0.0 * alpha + self.slowest)
        s, _ = saturated(0.5 * omega * (place - goal), 0.0 * goal, self.per_speed)
        acceleration = goal_a - 2.0 * omega * (velocity - goal_v + s)
        change = self.dt * select(waits, 0.0 * goal_v, acceleration)
        after = place + self.dt * velocity + 0.5 * self.dt * change, velocity + change
        found = select(seen | known, 1.0, 0.0)
        return np.concatenate([*after, np.array([found])]), (place, velocity, acceleration)


def reference(
    J_hat: Array,
    J_hat_dot: Array,
    u: Array,
    u_dot: Array,
    null: Array,
    null_dot: Array,
    singular_ratio: float = SINGULAR_RATIO,
    scale: float = 0.0,
) -> tuple[Array, Array, float]:
    """Return q̇_r = Ĵ⁺(u − Ĵn₀) + n₀ and its derivative, with Ĵ⁺ of `damped_gram_solve`.

    With w = (ĴĴᵀ + λ²I)⁻¹(u − Ĵn₀) and h = Ĵ'ᵀw + n₀', differentiating the definition gives

        q̈_r = h + Ĵ⁺(u' − Ĵ'q̇_r − Ĵh − (λ²)'w).

    Each derivative is along the motion. Returned are q̇_r, q̈_r and λ.
    """
    G = J_hat.dot(J_hat.T)
    solve, singular = regular_solver(G, singular_ratio, scale)

    def solved(solve: Callable[[Array], Array], rate: Any) -> tuple[Array, Array]:
        """Return q̇_r and q̈_r with b ↦ (ĴĴᵀ + λ²I)⁻¹b and (λ²)', None of no damping."""
        w = solve(u - J_hat.dot(null))
        velocity = w.dot(J_hat) + null
        h = w.dot(J_hat_dot) + null_dot
        rest = u_dot - J_hat_dot.dot(velocity) - J_hat.dot(h)
        if rate is not None:
            rest = rest - rate * w
        return velocity, h + solve(rest).dot(J_hat)

    def damped() -> tuple[Array, Array, Any]:
        solve, ends, damping = damped_solver(G, singular_ratio, scale)
        rate = damping_rate(J_hat, J_hat_dot, ends, singular_ratio, scale)
        return *solved(solve, select(damping > 0.0, rate, 0.0)), root(damping)

    return choose(singular, damped, lambda: (*solved(solve, None), 0.0))


def reference_step(
    error: PredictedError,
    v: Array,
    null: tuple[Array, Array],
    waits: Any,
    gains: ReferenceGains,
    motion: Array | None = None,
) -> tuple[Array, Array, Any, Any]:
    """Return q̇_r and q̈_r that bring a predicted error to zero, and their status.

    `null` are n₀ and its derivative; the joints rest while it `waits` for a first prediction.

    With the diagonal r of the joints' shares,

        q̇_r = n₀ + r (Ĵr)⁺(u − Ĵn₀),

    so that Ĵq̇_r = u, which is all that proofs need, and q̈_r is its derivative. Joints that this
    would bring to a stop that is near, at the positions `motion` (n_v,), leave the motion to the
    others, by `StopZones.shares`.

    Returns:
        q̇_r; q̈_r; whether Ĵ⁺ is damped; whether all is finite, else the joints rest.
    """
    z, J_hat, J_hat_dot, x_d_dot, x_d_ddot, drift = error
    z_dot = J_hat.dot(v) - x_d_dot + drift
    u, u_dot = task_velocity(
        z, z_dot, x_d_dot, x_d_ddot, gains.alpha, gains.per_speed, gains.alpha_dot
    )
    if gains.beside is not None:
        u, u_dot = u - gains.beside[0], u_dot - gains.beside[1]
    is_known = all_finite([*u.tolist(), *u_dot.tolist(), *J_hat.ravel().tolist()])

    ratio, stops, none = (gains.singular_ratio, gains.scale), gains.stops, np.zeros(len(v))

    def shared(r: Array, r_dot: Array) -> tuple[Array, Array, Any]:
        n, n_dot = null
        b = u - J_hat.dot(n), u_dot - J_hat_dot.dot(n) - J_hat.dot(n_dot)
        J_r, J_r_dot = J_hat * r, J_hat_dot * r + J_hat * r_dot
        p, p_dot, damping = reference(J_r, J_r_dot, *b, none, none, *ratio)
        return n + r * p, n_dot + r_dot * p + r * p_dot, damping

    def moves() -> tuple[Array, Array, Any]:
        shares = gains.shares
        if shares is None:
            v_r, a_r, damping = reference(J_hat, J_hat_dot, u, u_dot, *null, *ratio)
        else:
            v_r, a_r, damping = shared(shares, none)
        if stops is None or motion is None or stops.are_far(motion, v_r):
            return *within_speeds(v_r, a_r, gains.fastest), damping
        near, sides = stops.near(motion)
        found = none + _ONE if shares is None else shares, none, v_r, a_r, damping
        for _ in range(_PASSES):  # what some joints leave may bring others to a stop
            towards = (near > _ZERO) & (sides * found[2] > _ZERO)

            def away(towards: Any = towards, found: tuple[Any, ...] = found) -> tuple[Any, ...]:
                columns = towards, *found[:2], near, sides, v, *found[2:4], stops.zone, stops.slow
                rows = zip(*(column.tolist() for column in columns), strict=True)
                each = (row[:2] if is_so is False else smaller_share(*row) for is_so, *row in rows)
                r, r_dot = map(array, zip(*each, strict=True))
                return r, r_dot, *shared(r, r_dot)

            found = choose(any_of(towards), away, partial(tuple, found))
        *_, v_r, a_r, damping = found
        return *within_speeds(v_r, a_r, gains.fastest), damping

    still = waits | complement(is_known)
    v_r, a_r, damping = choose(still, lambda: (none, none, 0.0), moves)
    return v_r, a_r, damping > 0.0, is_known


def within_speeds(velocity: Array, acceleration: Array, fastest: Array) -> tuple[Array, Array]:
    """Return c q̇_r and its derivative, with the largest c ≤ 1 and all abs(c q̇_r,i) ≤ fastestᵢ.

    Where c = fastestᵢ/abs(q̇_r,i) of one joint, c' = −c q̈_r,i/q̇_r,i.
    """
    shares = np.abs(velocity) / fastest
    if not shares.dtype.hasobject:
        i = int(shares.argmax())
        share, v_i, a_i = float(shares[i]), velocity[i], acceleration[i]
        if share <= 1.0:
            return velocity, acceleration
    else:
        share, v_i, a_i = shares[0], velocity[0], acceleration[0]
        for each, v_next, a_next in zip(shares[1:], velocity[1:], acceleration[1:], strict=True):
            more = each > share
            share, v_i = select(more, each, share), select(more, v_next, v_i)
            a_i = select(more, a_next, a_i)
    c, rate = 1.0 / share, a_i / select(share > 1.0, v_i, 1.0)
    slow = velocity * c, (acceleration - velocity * rate) * c
    return choose(share > 1.0, lambda: slow, lambda: (velocity, acceleration))


def tracking_torque(feedforward: Array, K_sigma: Array) -> Array:
    """Return τ = Y_d(q, q̇, q̇_r, q̈_r) â − K_σσ, with σ = q̇ − q̇_r and both terms given.

    V̇₂ = −σᵀK_σσ for each K_σ with a positive definite symmetric part, whatever it depends on: it
    is not in V₂.
    """
    return feedforward - K_sigma


def bounded_damping(A: Array, A_sigma: Array, most: Array) -> Array:
    """Return K_σσ with K_σ = (A⁻¹ + B⁻¹)⁻¹ = B(A + B)⁻¹A, which is ≤ A and ≤ B = diag(most).

    Args:
        A: Symmetric and positive definite, (n_v, n_v).
        A_sigma: Aσ, (n_v,).
        most: Largest damping of each joint > 0, (n_v,).
    """
    return most * np.linalg.solve(A + np.diag(most), A_sigma)


class SlowFeedback(NamedTuple):
    """Feedback of σ and z below a frequency ω₀, beside the K_σ and α that motors stand.

    Behind a gear that gives way the lag of q̇ limits what a motor may damp, as the gear swings;
    below ω₀ it does not. The law's τ has −Kφ besides, φ̇ = ω₀(σ − φ), with K = (κ₀/κ)(A − K_σ) of
    `bounded_damping`: damping κ₀(M̂ + F) of what is slow where joints are soft, none where they are
    stiff. Its u has −w besides, ẇ = ω₀(s(α₀z) − w), where α is below α₀, by the rest of it.

    With V = V₂ + φᵀKφ/2ω₀, V̇ = −σᵀK_σσ − φᵀ(K − K̇/2ω₀)φ, negative as long as K does not grow by
    e² within 1/ω₀, which it does with M̂ and where gains fall. Without σ, and with one speed for all
    in s, z goes to zero by ∫s(α₀z)ᵀdz + wᵀw/2ω₀.
    """

    omega: float  # ω₀ [1/s]
    share: float  # κ₀/κ
    alpha: float  # α₀ [1/s]
    dt: float

    def damping(self, phi: Array, sigma: Array, A: Array, most: Array) -> tuple[Array, Array]:
        """Return φ a period later, and Kφ; A and `most` are those of `bounded_damping`."""
        A_phi = A.dot(phi)
        after = phi + self.dt * self.omega * (sigma - phi)
        return after, self.share * (A_phi - bounded_damping(A, A_phi, most))

    def rate(self, w: Array, z: Array, alpha: Any, per_speed: float | Array) -> Array:
        """Return ẇ beside the α of a step."""
        rest = select(alpha < self.alpha, self.alpha - alpha, 0.0 * alpha)
        return self.omega * (saturated(rest * z, 0.0 * z, per_speed)[0] - w)


_PASS, _LASTS, _SWINGS = 3, 0.88, 8.0  # filters; energy that lasts, over so many half swings
_OUTSTANDS, _USUAL = 3.0, 1.0  # times the usual size of what passes, over so long [s]
_MEAN, _SLOWEST = 2.0, 2.0  # half swings at ω₉₀: of the energy's mean, and the longest that counts
_FASTEST, _AT_FIRST = 7.0, 2.0  # times ω₉₀ at most; usual size at first, over the least speed
_COARSEST, _NOTHING = 1e-3, 1e-9  # encoder's step at most [rad or m]; speed that is none of its
_TONE, _STEP = 0.6, 0.25  # of the tone of a step to and fro each period, and of it, that are noise
_RISE, _SLOWER, _LEAVES = 0.5, 0.25, 0.5  # time to rise by e [s]; rate and damping after a swing
_SLOWEST_RISE = 0.02  # rate [1/s]
_RAISED = 1.3  # times the first damping, from which on a swing tells of what was raised
_WAITS = 4.0  # half swings at ω₉₀ without another, as the mean lags


class RaisedDamping(NamedTuple):
    """Shares w in [0, 1] of more damping, raised until a joint swings where the loop lags by 90°.

    Below that frequency ω₉₀ no damping of a motor makes it unstable, so only what passes three
    high-passes at 0.7 ω₉₀ is looked at. A joint swings if the energy of that does not fall by an
    eighth in eight half swings, and stands out from what usually passes and from the tone of an
    encoder's steps. Then its damping falls to half, and rises at a quarter of the rate, which is at
    first by e in 0.5 s; less where what usually passes, noise, is felt. A swing near the damping at
    first leaves the rate, as it tells nothing of more damping. No proof asks what the damping is:
    see `tracking_torque`.

    Its memory are fourteen numbers of each joint: w, that rate, the low-passes, and what finds
    swings and an encoder's steps.
    """

    smooth: float  # shares of the low-passes, and of the energy's mean, in a period
    mean: float
    half: float  # periods of half a swing at ω₉₀
    least: Array  # speed below which no swing counts, (n_v,) [rad/s or m/s]
    first: Array  # damping at w = 0, over what there is more of at w = 1, (n_v,)
    loud: Array  # that more, over the torque that what usually passes may cause, (n_v,) [s/rad]
    dt: float
    fresh: float  # share of the latest difference of q in q̇
    tone: float  # swing that a step to and fro each half swing looks like, over q̇'s change by one

    @classmethod
    def of(
        cls,
        omega: float,
        least: Array,
        damping: tuple[Array, Array],
        quiet: Array,
        dt: float,
        filtered: float = 0.0,
    ) -> RaisedDamping:
        """Return that of a loop whose lag is 90° at ω₉₀.

        Args:
            omega: ω₉₀ [rad/s].
            least: Speed below which no swing counts, (n_v,) [rad/s or m/s].
            damping: Damping at w = 0, and what is added at w = 1 > 0, (n_v,) each.
            quiet: Torque that noise of q̇ may cause, (n_v,) [N m or N].
            dt: Period [s].
            filtered: Time constant of the filter of q̇, which is of differences [s].
        """
        (of, more), half = damping, np.pi / (omega * dt)
        smooth, mean = 1.0 - np.exp([-0.7 * omega * dt, -1.0 / (_MEAN * half)])
        fresh = dt / (filtered + dt)
        tone = _TONE * np.sqrt(2.0) / (2.0 - fresh) * (2.0 / (2.0 - smooth)) ** _PASS
        parts = half, least, of / more, more / quiet, dt, fresh, float(tone)
        return cls(float(smooth), float(mean), *parts)

    def start(self, v: Array) -> Array:
        """Return the memory before the first period."""
        n = len(v)
        memory = np.zeros_like(v, shape=(_PASS + 11) * n)
        memory[n : 2 * n], memory[2 * n : 3 * n] = 1.0 / _RISE, v
        memory[-3 * n : -2 * n] = _AT_FIRST * self.least
        memory[-2 * n : -n] = v / max(1.0 - self.fresh, _NOTHING)  # before a step without a change
        memory[-n:] = _COARSEST * self.fresh / self.dt
        return memory

    def step(self, memory: Array, v: Array) -> tuple[Array, Array]:
        """Return the memory a period later, and the rates of w in between, (n_v,)."""
        share, pace, *past = memory.reshape(_PASS + 11, len(v))
        passed, rows = v, []
        for slow in past[:_PASS]:
            rows.append(slow + self.smooth * (passed - slow))
            passed = passed - slow
        before, first, energy, most, swings, age, usual, last, count = past[_PASS:]
        moved = np.abs(v - (1.0 - self.fresh) * last)
        count = np.where(moved > _NOTHING, np.minimum(moved, count), count)
        first = first + self.mean * (passed * passed - first)  # twice, as it beats at 2ω
        energy = energy + self.mean * (first - energy)
        over = (energy < _LASTS * most) | (age > _SWINGS * _SLOWEST * self.half)
        swings = np.where(over, 0.0, np.where(passed * before < 0.0, swings + 1.0, swings))
        least = np.maximum(self.tone * count, self.least)
        stands_out = 2.0 * energy >= np.maximum(_OUTSTANDS * usual, least) ** 2
        rings = (swings >= _SWINGS) & (_FASTEST * age >= self.half * swings) & stands_out
        over = over | rings
        usual = usual + self.dt / _USUAL * (np.minimum(np.abs(passed), 2.0 * usual) - usual)
        rows += [
            passed,
            first,
            energy,
            np.where(over, energy, np.maximum(most, energy)),
            np.where(over, 0.0, swings),
            np.where(rings, -_WAITS * self.half, np.where(over, 0.0, age + 1.0)),
            np.maximum(usual, self.least / _OUTSTANDS),
            v,
            count,
        ]
        damping = share + self.first
        noise = np.maximum(usual, _STEP * count)
        calm = np.maximum(1.0 - self.loud * damping * noise, -1.0)
        rate = np.minimum(pace * calm * damping, (1.0 - share) / self.dt)
        rate = np.maximum(rate, -share / self.dt)
        left = np.maximum(_LEAVES * damping - self.first, 0.0)
        slower = rings & (damping > _RAISED * self.first)
        share = np.where(rings, left, share + self.dt * rate)
        return np.concatenate(
            [share, np.where(slower, np.maximum(_SLOWER * pace, _SLOWEST_RISE), pace), *rows]
        ), rate


def smallest(values: Array, rates: Array) -> tuple[Any, Any]:
    """Return the smallest of some values, and its rate."""
    if not values.dtype.hasobject:
        i = int(values.argmin())
        return values[i], rates[i]
    least, rate = values[0], rates[0]
    for value, each in zip(values[1:], rates[1:], strict=True):
        less = value < least
        least, rate = select(less, value, least), select(less, each, rate)
    return least, rate


def dynamics_rate(gamma: Array, Y_d_sigma: Array) -> Array:
    """Return dâ/dt = −Γ Y_dᵀσ, shape (p,), with the diagonal of Γ and Y_dᵀσ, (p,) each."""
    return -gamma * Y_d_sigma


def servo_lag_rate(gamma: float, acceleration: Array, sigma: Array) -> Any:
    """Return dL̂/dt = −γ wᵀσ, of a servo with L q̈ + q̇ = q̇_cmd that is sent q̇_r + L̂w.

    With q̈_r = w + Dσ, Lσ̇ = −(I + LD)σ + (L̂ − L)w, and V₃ = ½L‖σ‖² + (L̂ − L)²/2γ has
    V̇₃ = −σᵀ(I + LD)σ.
    """
    return -gamma * acceleration.dot(sigma)
