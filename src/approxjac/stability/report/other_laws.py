"""`OtherLawReport`: the tests of a controller without certificates."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from approxjac.controllers import Latency
from approxjac.errors import InvalidInputError
from approxjac.formatting import percent, plain, wrapped
from approxjac.robots.traced import motion_between, moved
from approxjac.simulation import Sensing
from approxjac.stability.loop.configurations import inverse_kinematics
from approxjac.stability.loop.linearization import LocalStability, LocalTest, local_stability
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.stability.rollouts.setting import RolloutSetting
from approxjac.stability.rows import Row, about_timing, as_json, as_text
from approxjac.stability.search.worst import climb
from approxjac.tasks.analysis import sees
from approxjac.validation import Array

_MOST_TARGETS = 150
_SEARCHED, _LOOKS = 20, 2  # targets from which on a search follows, of so many steps
_AGAINST = {"not stable", "fail"}  # verdicts that speak against a law


@dataclass(frozen=True, eq=False, repr=False)
class OtherLawReport:
    """Findings about a controller without certificates: nothing is proven of it.

    Attributes:
        setting: The controller, the errors, and their random draws.
        latency: Latency of the loop.
        reason: Reason why no certificate covers it.
        local: Linearisation of the sampled loop with its delays at targets of the region, drawn,
            and the worst that a search from these finds.
        values: Values of the uncertain numbers at each of these, shape (N, d).
        refused: Reason → number of targets left out.
        rollouts: The rollouts, or None if not requested.
    """

    setting: RolloutSetting
    latency: Latency
    reason: str
    local: LocalTest
    values: Array
    refused: Mapping[str, int]
    rollouts: Rollouts | None

    @property
    def passed(self) -> bool:
        """True if a test applies, and all that apply pass: no proof, but no contradiction."""
        verdicts = {row.verdict for row in self.rows}
        return not verdicts & _AGAINST and bool(verdicts & {"stable", "pass"})

    @cached_property
    def rows(self) -> list[Row]:
        """The findings: test, verdict and figures."""
        none = {"reason": self.reason}
        certificates = Row("other law", "certificates", "not applicable", none, self.reason)
        law = "; ".join(self.setting.controller.describe()[:2])
        errors = self.setting.uncertainty.describe_box()
        rows = [Row("about", "law", "", {"law": law}, law), about_timing(self.latency)]
        rows += [Row("about", "errors", "", {"errors": errors}, errors), certificates]
        return [*rows, self._near(), self._simulated()]

    def _near(self) -> Row:
        local, verdict, n = self.local, "not applicable", len(self.local.q)
        figures: dict[str, Any] = {"refused": self.refused}
        texts = [f"{n} left out: {why}" for why, n in self.refused.items()]
        if n:
            verdict = "stable" if local.stable and not self.refused else "not stable"
            decay, ratio = local.decay_rates.min(), local.damping_ratios.min()
            truth = self.setting.uncertainty.describe(self.values[local.worst])
            figures |= {"targets": n, "share": local.share, "decay": decay}
            figures |= {"damping_ratio": ratio, "worst_truth": truth}
            texts.insert(
                0,
                f"stable at {percent(local.share)} % of {n} targets, slowest decay {decay:.3g} "
                f"1/s, damping ratio at least {ratio:.2g}; the slowest with {truth}",
            )
        return Row("other law", "near targets", verdict, figures, "; ".join(texts))

    def _simulated(self) -> Row:
        many = self.rollouts
        if many is None:
            return Row("other law", "rollouts", "not run", {}, "report(runs=100) runs them")
        converged = many.rows[0]
        passes = "pass" if many.n_converged == many.n else "fail"
        text = f"{converged.verdict} {converged.text}"
        return Row("other law", "rollouts", passes, converged.figures, text)

    def verdict(self) -> str:
        """Return the outcome in a line."""
        if self.passed:
            return "nothing is proven of this law; no test that applies speaks against it"
        if not {row.verdict for row in self.rows} & _AGAINST:
            return "nothing is proven of this law, and no test that applies was run: see below"
        return "nothing is proven of this law, and a test speaks against it: see below"

    def __repr__(self) -> str:
        return f"OtherLawReport({self.setting.controller!r}: {self.verdict()})"

    def __str__(self) -> str:
        return "\n".join([*wrapped(self.verdict()), as_text(self.rows)])

    def summary(self) -> dict[str, Any]:
        """Return the part of summary.json."""
        about = {"passed": self.passed, "seed": self.setting.seed}
        return about | {"decay_rates": plain(self.local.decay_rates)} | as_json(self.rows)


def near_targets(
    setting: RolloutSetting,
    latency: Latency,
    count: int,
    tell: Callable[[float], None] = lambda share: None,
) -> tuple[LocalTest, Array, Mapping[str, int]]:
    """Linearise a sampled loop at the targets of the first rollouts of a setting, 150 at most.

    A start that is drawn is the target, unless there is one. From the worst of these a search goes
    on, over robots and targets together. Frames of x count as a delay of half the time between
    them. `LocalTest.truth` are the indices of the rollouts, −1 for what the search finds; with it
    come the values of the uncertain numbers, shape (N, d), and how many targets were left out, by
    the reason.
    """
    late = Sensing(
        x_delay=latency.image_age + 0.5 * latency.image_period,
        velocity_filter=latency.velocity_filter or None,
    )
    setting = replace(setting, sensing=late, actuator_delay=latency.torque_delay)
    results, where, indices, values = list[LocalStability](), [], [], []
    refused, errors, box = Counter[str](), setting.uncertainty, setting.region.box
    count, d = min(count, _MOST_TARGETS), setting.uncertainty.d
    for k in range(count):
        tell(k / count)
        start = setting.start(k)
        q: Array | None = start.q
        if setting.target is not None:
            q = inverse_kinematics(start.plant.sensor, start.target, start.q)
        if q is None:
            refused["no configuration near the start attains the target"] += 1
            continue
        try:
            results.append(local_stability(start.plant, setting.controller, q, setting.dt))
        except InvalidInputError as error:
            refused[str(error).split(", got ")[0]] += 1
            if k == 0:  # of the law, not of the target
                break
            continue
        where.append(q)
        indices.append(k)
        values.append(start.values)

    def growth(z: Array) -> Array:
        rates = np.full(len(z), -np.inf)
        for k, (own, motion) in enumerate(zip(errors.at(z[:, :d]), z[:, d:], strict=True)):
            q = moved(box.robot, box.center, motion * box.upper)
            plant = errors.plant(own)._sensed(setting.sensing, setting.actuator_delay)
            if not (setting.region.contains(q) and sees(plant.sensor, q)):
                continue
            try:
                found = local_stability(plant, setting.controller, q, setting.dt)
            except InvalidInputError:
                continue
            rates[k] = found.max_real_eigenvalue
            if len(looked) == 0 or rates[k] > looked[0][0]:
                looked[:] = [(rates[k], found, q, own)]
        return rates

    looked: list[tuple[float, LocalStability, Array, Array]] = []
    if results and setting.target is None and count >= _SEARCHED:
        k = int(np.argmax([each.max_real_eigenvalue for each in results]))
        motion = motion_between(box.robot, box.center, where[k])
        motion = motion / np.where(box.upper > 0.0, box.upper, 1.0)
        begun = np.append(errors.units_of(values[k][None])[0], motion)
        climb(growth, np.clip(begun, -1.0, 1.0)[None], _LOOKS)
        for _, found, q, own in looked:
            results.append(found)
            where.append(q)
            indices.append(-1)
            values.append(own)
    local = LocalTest.of(results, np.array(where), np.array(indices, dtype=int))
    return local, np.array(values).reshape(len(results), d), refused
