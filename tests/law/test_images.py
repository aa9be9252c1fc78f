"""Rays of points in a camera, against differences and against turns that are known."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac import law


def test_rays_have_their_jacobian(rng):
    c, h, stretch = rng.normal(size=(4, 3)) + [0.0, 0.0, 5.0], 1e-6, 1.3
    for axis, step in enumerate(h * np.eye(3)):
        slope = (law.images.rays(c + step, stretch) - law.images.rays(c - step, stretch)) / (
            2.0 * h
        )
        assert_allclose(law.images.ray_jacobian(c, stretch)[:, :, axis], slope, atol=1e-9)


def test_a_point_is_beside_its_own_ray_by_nothing(rng):
    c = rng.normal(size=(4, 3))
    for Z in (2.0, -2.0):  # before the camera and behind it
        c[:, 2] = Z
        beside = (law.images.ray_basis(law.images.rays(c, 1.0)) @ c[:, :, np.newaxis])[..., 0]
        assert_allclose(beside, 0.0, atol=1e-12)
        c_moved = c + [0.1, -0.2, 0.0]
        beside = (law.images.ray_basis(law.images.rays(c, 1.0)) @ c_moved[:, :, np.newaxis])[..., 0]
        assert_allclose(beside, np.tile([0.1, -0.2], (4, 1)))


@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5, 3.1])
def test_a_turn_of_the_image_is_found(rng, turn):
    shown, weights = rng.normal(size=(6, 2)), rng.uniform(1.0, 3.0, size=6)
    c, s = np.cos(turn), np.sin(turn)
    seen = 0.7 * shown @ np.array([[c, -s], [s, c]]).T + [0.3, -0.1]
    others = np.array([shown, rng.normal(size=(6, 2)), 0.0 * shown])  # the last does not move
    angles, left = law.images.image_turn(others, seen, weights)
    assert angles[0] == pytest.approx(turn)
    assert left[0] == pytest.approx(0.0, abs=1e-12)
    assert left[2] >= left[1] > 0.01
    assert_allclose(law.images.image_turn(shown[:1], seen[:1], weights[:1]), 0.0)
