"""`ProvenLaw`: a law with a V that falls along an output y, which limits of torques build on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, Self

from approxjac.controllers import in_words
from approxjac.controllers.gains.latency import Latency
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.robots import Dynamics
from approxjac.tasks import Task
from approxjac.validation import Array, Immutable


class ProvenLaw(Immutable, ABC):
    """A law whose V̇ changes by yᵀ(τ − τ*) where τ takes the place of its own torque τ*.

    Any τ with yᵀ(τ − τ*) ≤ 0 keeps what is proven of V̇. This is what `Limiter` needs to know.

    Attributes:
        task: The task of the believed robot.
        command: "torque", or "velocity" of a law whose commands no limiter of torques is for.
        latency: Of the loop, if it is known.
        alpha: α of y [1/s] where none is given.
    """

    task: Task
    command: Literal["torque", "velocity"] = "torque"
    latency: Latency | None = None
    alpha: float

    def __str__(self) -> str:
        return in_words.text(self)  # type: ignore[arg-type]  # there are two laws

    @property
    @abstractmethod
    def dt(self) -> float | None:
        """Sampling time that control has to have [s], or None where any will do."""

    @abstractmethod
    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,)."""

    @abstractmethod
    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and torque and status for it."""

    @abstractmethod
    def learnt(self, state: Array) -> Array:
        """Return what a state, or a series of them (…, n_state), has learnt, shape (…, p)."""

    @abstractmethod
    def with_task(self, task: Task) -> Self:
        """Return this law with another task, such as that of another believed robot."""

    @abstractmethod
    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the gravity torque that this law compensates, shape (n_v,) [N m or N]."""

    @abstractmethod
    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return y where this law gave an answer, shape (n_v,) [rad/s or m/s].

        Args:
            answer: The answer.
            v: The joint velocity that it was given for, shape (n_v,), less the answer's reference
                if there is one. (y is linear in it: the reference may be subtracted afterwards.)
            alpha: α [1/s], for a law whose y has one.
        """

    def is_proven(self, answer: Evaluation) -> bool:
        """Return whether V̇ is known where this law gave an answer: with x, and with Ĵ⁺."""
        return answer.status is Status.OK

    @property
    @abstractmethod
    def resting(self) -> int:
        """Return how many of the state's first numbers rest where the proof is given up."""

    def with_limiter(self, motors: Array) -> ProvenLaw:
        """Return this law as it is inside of a limiter, which decides when it rests.

        Args:
            motors: Largest torques that the limiter sends, shape (n_v,).
        """
        return self

    @abstractmethod
    def resolved_alpha(self, alpha: float | None) -> float:
        """Return α of y [1/s], or refuse one that does not fit; None asks for the usual one."""

    @abstractmethod
    def damping_rate(self, inertias: Array) -> float:
        """Return how fast this law damps joints [1/s], given usual inertias (k, n_v, n_v)."""

    @abstractmethod
    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        """Return the dynamics that predict what a torque does, and whether they have gravity.

        Without it the gravity of the law's answer is subtracted, which may be that of a robot that
        compensates itself.
        """
