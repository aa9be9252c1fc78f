"""The law of classical visual servoing, and speeds that joints may not exceed."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from approxjac import law


def test_of_all_velocities_that_move_the_task_it_takes_the_shortest(rng):
    J, s = rng.normal(size=(3, 7)), rng.normal(size=3)
    reference, damping = law.velocity_reference(J, s, 3.0)
    assert damping == 0.0
    assert_allclose(J @ reference, -3.0 * s)
    self_motions = np.linalg.svd(J)[2][3:]
    assert_allclose(self_motions @ reference, 0.0, atol=1e-12)


def test_near_a_singular_pose_it_says_how_much_it_is_damped():
    J, s = np.diag([1.0, 0.5, 0.01]), np.ones(3)
    reference, damping = law.velocity_reference(J, s, 2.0)
    w, expected = law.damped_gram_solve(J @ J.T, s)
    assert damping == expected > 0.0
    assert_allclose(reference, -2.0 * J.T @ w)
    # a J that is as a whole smaller than its scale is near singular too
    assert law.velocity_reference(0.01 * np.eye(3), s, 2.0)[1] == 0.0
    assert law.velocity_reference(0.01 * np.eye(3), s, 2.0, 1.0)[1] > 0.0


def test_speeds_are_scaled_as_a_whole():
    assert_array_equal(law.within_speeds(np.array([4.0, -3.0]), np.array([2.0, 2.0])), [2.0, -1.5])
    # the joint that is furthest beyond its own limit counts, whichever way it goes
    assert_array_equal(law.within_speeds(np.array([4.0, -3.0]), np.array([8.0, 1.0])), [4 / 3, -1])
    assert_array_equal(law.within_speeds(np.array([4.0, -3.0]), np.array([4.0, 3.0])), [4.0, -3.0])
    assert_array_equal(law.within_speeds(np.array([0.3, -0.2]), np.ones(2)), [0.3, -0.2])
    assert_array_equal(law.within_speeds(np.zeros(2), np.ones(2)), np.zeros(2))


def test_speeds_of_joints_without_a_limit_are_left_alone():
    assert_array_equal(law.within_speeds(np.array([1e9, -1e9]), np.full(2, np.inf)), [1e9, -1e9])
