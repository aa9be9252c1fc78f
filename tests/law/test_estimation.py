"""Theorem A in samples, and rotations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from potentials import V1

from approxjac import law


def test_v1_falls_by_what_is_said_with_each_frame_and_never_rises(rng):
    """Whatever the regressors: no excitation, no noise; forgetting lets it fall, too."""
    n, noise = 6, 2e-3
    prior = rng.uniform(5.0, 50.0, n) ** 2
    truth, Theta, P = rng.standard_normal(n), np.zeros(n), np.diag(1.0 / prior)
    H = rng.standard_normal((3, n))
    for _ in range(300):
        H = H + 0.02 * rng.standard_normal(H.shape)
        before = V1(np.linalg.inv(P), truth - Theta)
        exactly = np.linalg.inv((1.0 - 5e-4) * np.linalg.inv(P) + 5e-4 * np.diag(prior))
        P = law.forgotten(P, prior, 5e-4)
        assert_allclose(P, exactly, rtol=0, atol=1e-6 * np.abs(P).max())
        forgotten = V1(np.linalg.inv(P), truth - Theta)
        assert forgotten <= before * (1 + 1e-9)
        innovation = H @ truth - H @ Theta
        S = noise**2 * np.eye(3) + H @ P @ H.T
        fall = 0.5 * innovation @ np.linalg.solve(S, innovation)
        K = law.gain(P, H, noise**2)
        P, Theta = P - K @ H @ P, Theta + K @ innovation
        after = V1(np.linalg.inv(P), truth - Theta)
        assert after == pytest.approx(forgotten - fall, rel=1e-6, abs=1e-9)
        assert np.linalg.eigvalsh(np.diag(1.0 / prior) - P)[0] > -1e-12
        assert (truth - Theta) @ (prior * (truth - Theta)) <= truth @ (prior * truth)


vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).filter(
    lambda a: np.linalg.norm(a) > 1e-3
)


@given(vectors, st.floats(0.0, np.pi))
def test_a_rotation_vector_comes_back(direction, angle):
    phi = angle * np.array(direction) / np.linalg.norm(direction)
    R = law.rotation_exp(phi)
    assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    again = law.rotation_log(R)
    assert_allclose(law.rotation_exp(again), R, atol=1e-7)
    assert np.linalg.norm(again) <= np.pi + 1e-12
    if angle < np.pi - 1e-6:
        assert_allclose(again, phi, atol=1e-6)


@pytest.mark.parametrize("angle", [1e-9, 1e-7, 1e-4, 3.0, 3.05, np.pi - 1e-5, np.pi - 1e-8, np.pi])
@pytest.mark.parametrize("axis", [(1, 0.2, -0.1), (-0.3, -1, 0.1), (0.2, 0.1, -1), (0, 0, 1)])
def test_the_smallest_and_largest_rotation_vectors_come_back(angle, axis):
    phi = angle * np.array(axis) / np.linalg.norm(axis)
    again = law.rotation_log(law.rotation_exp(phi))
    if angle == np.pi:  # either of the two
        again = again * np.sign(again @ phi)
    assert_allclose(again, phi, rtol=1e-7, atol=1e-14)


@given(st.floats(-3.1, 3.1))
def test_an_angle_in_the_plane_comes_back(angle):
    R = law.rotation_exp(np.array([angle]))
    assert_allclose(R @ [1.0, 0.0], [np.cos(angle), np.sin(angle)], atol=1e-12)
    assert law.rotation_log(R)[0] == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_the_nearest_rotation_is_kabschs(d, rng):
    R = law.nearest_rotation(rng.standard_normal((d, d)))
    assert np.linalg.det(R) == pytest.approx(1.0)
    points = rng.standard_normal((5, d))
    assert_allclose(law.nearest_rotation((points @ R.T).T @ points), R, atol=1e-12)
    mirrored = R @ np.diag([3.0, -2.0, 1.0][:d])
    best = np.vdot(law.nearest_rotation(mirrored), mirrored)
    assert best == pytest.approx([1.0, 4.0][d - 2])  # the smallest has the wrong sign


def test_no_rotation_is_far_from_all_of_those_everywhere(rng):
    everywhere = law.rotation.rotations_everywhere(3)
    assert everywhere.shape == (60, 3, 3)
    for _ in range(100):
        R = law.nearest_rotation(rng.standard_normal((3, 3)))
        nearest = max(np.trace(R.T @ other) for other in everywhere)
        assert np.degrees(np.arccos((nearest - 1.0) / 2.0)) < 45.0
    assert law.rotation.rotations_everywhere(2).shape == (12, 2, 2)


@pytest.mark.parametrize("d", [2, 3])
def test_the_best_rotation_is_a_maximum(d, rng):
    G = law.rotation.generators(d)
    for k in range(40):
        root, h = rng.standard_normal((d * d, 1 + k % 5)), rng.standard_normal(d * d)
        M, A = root @ root.T, law.nearest_rotation(rng.standard_normal((d, d)))
        curved = law.rotation.derivatives(M, h, A)[1]
        assert_allclose(curved, curved.T, atol=1e-12 * np.abs(curved).max())
        best = A
        for _ in range(10):
            before, best = best, law.rotation.best_rotation(M, h, best)
            least = law.rotation.explained(M, h, before)
            assert law.rotation.explained(M, h, best) >= least - 1e-12 * abs(least)
        value = law.rotation.explained(M, h, best)
        slope = law.rotation.tangents(best).T @ (M @ best.ravel() + h)
        assert_allclose(slope, 0.0, atol=1e-9 * (1.0 + np.abs(M).max()))
        assert np.linalg.eigvalsh(law.rotation.derivatives(M, h, best)[1])[0] > -1e-9  # no saddle
        turn, e = rng.standard_normal(len(G)), 1e-4
        after, before = (
            law.rotation.explained(M, h, law.rotation_exp(s * turn) @ best) for s in (e, -e)
        )
        assert after - before == pytest.approx(0.0, abs=1e-7 * abs(value))
        curvature = (after - 2.0 * value + before) / e**2
        assert curvature == pytest.approx(
            -turn @ law.rotation.derivatives(M, h, best)[1] @ turn, rel=1e-3
        )
        moved = (law.rotation_exp(e * turn) @ best - law.rotation_exp(-e * turn) @ best) / (2 * e)
        assert_allclose(law.rotation.tangents(best) @ turn, moved.ravel(), atol=1e-6)


def test_the_cross_matrix_turns_as_its_generators_do(rng):
    phi, a = rng.normal(size=3), rng.normal(size=3)
    assert_allclose(law.cross_matrix(phi) @ a, np.cross(phi, a))
    for angles in (phi, phi[:1]):
        expected = np.tensordot(angles, law.rotation.generators(2 if len(angles) == 1 else 3), 1)
        assert_allclose(law.cross_matrix(angles), expected)


@pytest.mark.parametrize("absurd", [np.nan, np.inf, 1e200])
def test_no_rotation_is_near_what_is_not_finite(absurd):
    """LAPACK's SVD was seen to go on for ever with such numbers, in a control step."""
    with pytest.raises(np.linalg.LinAlgError, match="must be finite"):
        law.nearest_rotation(np.diag([absurd, 1.0, 1.0]))
