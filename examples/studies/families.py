"""Which share of the stable two-link loops each family of Lyapunov functions certifies.

At the target, which is stable by its eigenvalues; and with one function for all configurations and
targets of a box around it, of the boxes in which all targets that are looked at are stable.

python examples/studies/families.py --out results/families
"""

import sys
from typing import NamedTuple

import numpy as np
from common import head, parser, row, run_all, write
from random_loops import KINDS, regular
from scipy.linalg import solve_continuous_lyapunov

import approxjac as aj
from approxjac import law
from approxjac.stability.certificates.matrix_form import (
    FAMILIES,
    MatrixForm,
    Weights,
    best_weights,
)
from approxjac.stability.loop.closed_loop import ClosedLoop

TWO_LINKS = ("two-link, camera", "two-link, lengths")
LOOPS, FEW, SEED = 800, 30, 22
SIZE = 3.0  # of errors at most: a roll of 270°, lengths wrong by a factor of 6
BOX, CONFIGURATIONS = 0.05, 60  # half width [rad]
NAMES = {
    "free": "free potential",
    "full": "coupled",
    "K": "coupled, K",
    "Lyapunov": "of Lyapunov's equation",
}


class Wider(NamedTuple):
    """V of `Weights` and ½ q̇ᵀMKM q̇, K symmetric."""

    weights: Weights
    K: np.ndarray  # shape (n_v, n_v)

    def plus(self, share, other):
        """Return this and a share of another."""
        return Wider(self.weights.plus(share, other.weights), self.K + share * other.K)


class AtRest(MatrixForm):
    """The form of `Wider`, without what is cubic in q̇: for targets alone, where q̇ → 0.

    With p = Mq̇, ṗ = Cᵀq̇ − Dq̇ − ĴᵀK_p s, so that ½pᵀKp has the rate
    −q̇ᵀMKD q̇ − q̇ᵀMKĴᵀK_p s and q̇ᵀMKCᵀq̇, which is left out.
    """

    def pencils(self, wider):
        """Return X and Y as `MatrixForm` has them."""
        X, Y = super().pencils(wider.weights)
        M, D, J_hat = self.samples.M, self._of_samples.D, self.samples.J_hat
        n, MK = M.shape[-1], M @ wider.K
        damping, pull = MK @ D, 0.5 * MK @ (J_hat.mT * self.setting.kp)
        X[0, :, :n, :n] += 0.5 * (damping + damping.mT)
        X[0, :, :n, n:] += pull
        X[0, :, n:, :n] += pull.mT
        X[1, :, :n, :n] += MK @ M
        return X, Y

    def margins(self, wider):
        """Return the margin of each sample, shape (N,)."""
        X, Y = self.pencils(wider)
        try:
            root = np.linalg.inv(np.linalg.cholesky(Y))
        except np.linalg.LinAlgError:
            return np.full(len(self.samples), -np.inf)
        return np.linalg.eigvalsh(root @ X @ root.mT)[..., 0].min(axis=0)

    def unknowns(self, family):
        """Return those of a family, and K."""
        found = super().unknowns(family)
        n, size = len(self.setting.B), 1.0 / np.trace(self.samples.M[0])
        none, zero = found.basis[0].plus(-1.0, found.basis[0]), np.zeros((n, n))
        units = [np.outer(a, b) + np.outer(b, a) for a in np.eye(n) for b in np.eye(n)]
        units = [units[i * n + j] for i in range(n) for j in range(i, n)]
        basis = [Wider(each, zero) for each in found.basis]
        basis += [Wider(none, size * unit) for unit in units]
        return found._replace(
            fixed=Wider(found.fixed, zero),
            basis=basis,
            start=np.append(found.start, np.zeros(len(units))),
            least=np.append(found.least, np.full(len(units), found.least.min())),
        )


class Outcome(NamedTuple):
    """What certifies a loop; None where its target is not stable."""

    at_target: dict | None
    in_box: dict | None


def draw(number):
    """Draw a loop and a configuration that attains its target."""
    rng = np.random.default_rng([SEED, number])
    kind = TWO_LINKS[number % len(TWO_LINKS)]
    sensor, task, q = regular(KINDS[kind], rng.uniform(0.0, SIZE), rng)
    usual = aj.default_gains(task)
    kp, kv, damping = 10.0 ** rng.uniform((-0.5, -0.5, -1.5), (0.5, 0.5, 1.0))
    damping *= rng.random() < 0.6
    gains = aj.Gains(
        *(f * np.asarray(g) for f, g in ((kp, usual.kp), (kv, usual.kv), (damping, usual.damping)))
    )
    controller = aj.SetpointController(task, gains, gravity=aj.NoGravity(task.robot))
    plant = aj.Plant(sensor.robot, sensor)
    return ClosedLoop(controller, plant, aj.JointBox.around(sensor.robot, q, BOX)), q


def run_case(number):
    """Ask each family about a loop."""
    closed, q = draw(number)
    target = closed.samples_at(
        np.zeros(1, dtype=int), q[None], closed.plants[0].sensor.value(q)[None]
    )
    if not is_stable(target, closed.setting):
        return Outcome(None, None)
    drawn, in_box = closed.draw(CONFIGURATIONS, np.random.default_rng(number)), None
    if is_stable(drawn, closed.setting) and closed.singular_configuration(drawn) is None:
        in_box = certified(MatrixForm(drawn, closed.setting))
    return Outcome(at_target(target, closed.setting), in_box)


def is_stable(samples, setting):
    """Return whether all samples, taken as targets, are stable."""
    return all(np.linalg.eigvals(A).real.max() < 0.0 for A in flows(samples, setting))


def flows(samples, setting):
    """Return the closed-loop matrix of each sample, taken as a target."""
    each = zip(samples.M, samples.J, samples.J_hat, strict=True)
    return [law.closed_loop_matrix(*at, setting.kp, setting.kv, setting.B) for at in each]


def certified(form):
    """Return which families certify."""
    return {name: bool(best_weights(form, name).margins.min() > 0.0) for name in FAMILIES}


def at_target(target, setting):
    """Return which families certify a target, those with K among them."""
    found, form = certified(MatrixForm(target, setting)), AtRest(target, setting)
    found["K"] = bool(best_weights(form, form.unknowns("full")).margins.min() > 0.0)
    found["Lyapunov"] = bool(form.margins(of_lyapunov(target, setting)).min() > 0.0)
    return found


def of_lyapunov(target, setting):
    """Return the solution of Lyapunov's equation at a target as `Wider`, of as many joints as m."""
    M, J, J_hat = target.M[0], target.J[0], target.J_hat[0]
    n = len(M)
    to_z = np.block([[np.zeros((n, n)), np.eye(n)], [J, np.zeros((n, n))]])  # (q̇, e) of (δq, q̇)
    (A,) = flows(target, setting)
    A = to_z @ A @ np.linalg.inv(to_z)
    D = law.dissipation(J_hat, setting.kv, setting.B)
    wanted = np.block([[D, np.zeros((n, n))], [np.zeros((n, n)), np.diag(setting.kp)]])
    X = solve_continuous_lyapunov(A.T, -2.0 * wanted)
    X *= np.trace(M) / np.trace(X[:n, :n])
    M_inv, W = np.linalg.inv(M), X[n:, n:]
    A1 = J_hat @ M_inv @ X[:n, n:]
    weights = Weights(A1, 0.0 * A1, np.diag(W).copy(), coupling=W - np.diag(np.diag(W)))
    return Wider(weights, M_inv @ (X[:n, :n] - M) @ M_inv)


def table(outcomes):
    """Return the counts as Markdown."""
    targets = [o.at_target for o in outcomes if o.at_target is not None]
    boxes = [o.in_box for o in outcomes if o.in_box is not None]
    lines = head("", "loops", *NAMES.values())
    for name, among in (("at the target", targets), (f"box ± {BOX:g} rad", boxes)):
        lines.append(row(name, len(among), *(share(among, test) for test in NAMES)))
    return "\n".join(lines) + "\n"


def share(among, test):
    """Return how many of them a test certifies, in words."""
    if not among or test not in among[0]:
        return "–"
    count = sum(each[test] for each in among)
    return f"{count} ({100.0 * count / len(among):.1f} %)"


def main(arguments=None):
    """Run the study; return the exit code."""
    given = parser(__doc__, "results/families").parse_args(arguments)
    loops = FEW if given.quick else LOOPS
    outcomes = run_all(run_case, range(loops), given.jobs)
    write(given.out, {"families.md": table(outcomes)}, {"outcomes": outcomes})
    return 0


if __name__ == "__main__":
    sys.exit(main())
