"""Trajectories of the study against an independent closed-form arm and integrator."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from two_link_closed_form import TwoLink, camera

from approxjac.paper import experiments as paper

BELIEFS = {  # figure: believed camera f, z, δ; believed lengths; K_p, K_v; from the paper's text
    3: ((0.05, 3.0, np.pi / 3), (1.0, 1.0, 0.5), 5000.0, 5000.0),
    4: ((0.05, 3.0, np.pi / 3), (1.0, 1.0, 0.5), 5000.0, 10000.0),
    5: ((0.05, 3.0, np.pi / 3), (1.0, 1.0, 0.5), 2500.0, 5000.0),
    6: ((0.05, 3.0, 0.0), (0.75, 1.25, 0.0), 5000.0, 5000.0),
    7: ((0.1, 4.0, np.pi / 3), (0.75, 1.25, 0.0), 5000.0, 30000.0),
    8: ((0.1, 4.0, np.pi / 3), (0.75, 1.25, 0.0), 5000.0, 30000.0),
}


def damped_pinv(J, ratio=0.02):
    """The same damping of singular poses, through an SVD instead of an eigenvalue problem."""
    U, values, Vt = np.linalg.svd(J)
    squared = max((ratio * values[0]) ** 2 - values[-1] ** 2, 0.0)
    return Vt.T @ np.diag(values / (values**2 + squared)) @ U.T


def closed_form_run(figure, times):
    truth, (f_z_delta, lengths, kp, kv) = TwoLink(), BELIEFS[figure]
    believed = TwoLink(*lengths)
    image, image_hat = camera(0.05, 3.0, 0.0), camera(*f_z_delta)
    target = image @ truth.h(np.radians([90.0, 90.0]))

    def flow(t, z):
        q, v, theta_hat = z[:2], z[2:4], z[4:]
        J_hat = image_hat @ believed.J(q)
        e = image @ truth.h(q) - target
        theta = theta_hat if figure == 8 else truth.theta()
        tau = -J_hat.T @ (kp * e + kv * J_hat @ v) + truth.Z(q) @ theta
        a = np.linalg.solve(truth.M(q), tau - truth.coriolis(q, v) - truth.g(q))
        rate = -0.12 * truth.Z(q).T @ (v + damped_pinv(J_hat) @ e)
        return np.concatenate([v, a, rate if figure == 8 else 0.0 * rate])

    start = np.concatenate([np.radians([60.0, 90.0]), np.zeros(4)])
    solution = solve_ivp(
        flow, (0.0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-11, atol=1e-12
    )
    error = np.array([image @ truth.h(q) - target for q in solution.y[:2].T])
    return solution.y[:2].T, solution.y[2:4].T, solution.y[4:].T, error


@pytest.mark.parametrize(
    "figure", [4, *(pytest.param(n, marks=pytest.mark.long) for n in sorted(BELIEFS) if n != 4)]
)
def test_trajectories_agree_to_1e_6(figure):
    result = paper.run_experiment(paper.EXPERIMENTS[figure], 20.0)
    run = result.run
    q, v, theta_hat, error = closed_form_run(figure, run.t)
    assert_allclose(run.q, q, rtol=0, atol=1e-6)
    assert_allclose(run.v, v, rtol=0, atol=1e-6)
    assert_allclose(run.error, error, rtol=0, atol=1e-6 * np.abs(error[0]).max())
    if figure == 8:
        assert_allclose(run.state, theta_hat, rtol=0, atol=1e-6)
