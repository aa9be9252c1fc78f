"""The mathematics of the paper: NumPy in, NumPy out, an equation a function.

Symbols are the paper's; misprints are corrected and each departure is named where it is made.
"""

from approxjac.law.adaptation import passive_output, theta_hat_rate, within_bounds
from approxjac.law.conditions import (
    allowed_p,
    allowed_p_at_crossing,
    allowed_p_position,
    allowed_p_velocity,
    best_alpha,
    jacobian_error,
    lambda_2,
    largest_allowed_p,
    largest_alpha,
)
from approxjac.law.estimation import (
    V1,
    V1_fall,
    correction,
    forgotten_information,
    information,
)
from approxjac.law.images import image_turn, ray_basis, ray_jacobian, rays
from approxjac.law.linearization import (
    adaptive_closed_loop_matrix,
    closed_loop_matrix,
    learning_gain,
)
from approxjac.law.lyapunov import V, W, parameter_potential
from approxjac.law.matrix_form import (
    cross_weight_damped,
    cross_weight_pinv,
    decrease_matrix,
    dissipation,
    inertial_block,
    potential_matrix,
    stiffness_block,
)
from approxjac.law.pseudoinverse import (
    SINGULAR_RATIO,
    damped_gram_solve,
    damping_rate,
    is_near_singular,
    right_pinv,
)
from approxjac.law.rotation import (
    best_rotation,
    cross_matrix,
    explained,
    generators,
    nearest_rotation,
    rotation_exp,
    rotation_information,
    rotation_log,
    rotations_everywhere,
    tangents,
)
from approxjac.law.sampled_loop import LinearLaw, frame_map
from approxjac.law.saturation import Linear, Saturation, Sine, Tanh
from approxjac.law.torque import (
    bounded_torque,
    bounded_torque_bound,
    estimated_velocity_torque,
    gravity,
    learnt_gravity_torque,
    measured_velocity_torque,
)
from approxjac.law.torque_limits import limited_torque
from approxjac.law.tracking import (
    dynamics_rate,
    reference,
    saturated,
    servo_lag_rate,
    tracking_potential,
    tracking_torque,
    within_speeds,
)

__all__ = [
    "SINGULAR_RATIO",
    "V1",
    "Linear",
    "LinearLaw",
    "Saturation",
    "Sine",
    "Tanh",
    "V",
    "V1_fall",
    "W",
    "adaptive_closed_loop_matrix",
    "allowed_p",
    "allowed_p_at_crossing",
    "allowed_p_position",
    "allowed_p_velocity",
    "best_alpha",
    "best_rotation",
    "bounded_torque",
    "bounded_torque_bound",
    "closed_loop_matrix",
    "correction",
    "cross_matrix",
    "cross_weight_damped",
    "cross_weight_pinv",
    "damped_gram_solve",
    "damping_rate",
    "decrease_matrix",
    "dissipation",
    "dynamics_rate",
    "estimated_velocity_torque",
    "explained",
    "forgotten_information",
    "frame_map",
    "generators",
    "gravity",
    "image_turn",
    "inertial_block",
    "information",
    "is_near_singular",
    "jacobian_error",
    "lambda_2",
    "largest_allowed_p",
    "largest_alpha",
    "learning_gain",
    "learnt_gravity_torque",
    "limited_torque",
    "measured_velocity_torque",
    "nearest_rotation",
    "parameter_potential",
    "passive_output",
    "potential_matrix",
    "ray_basis",
    "ray_jacobian",
    "rays",
    "reference",
    "right_pinv",
    "rotation_exp",
    "rotation_information",
    "rotation_log",
    "rotations_everywhere",
    "saturated",
    "servo_lag_rate",
    "stiffness_block",
    "tangents",
    "theta_hat_rate",
    "tracking_potential",
    "tracking_torque",
    "within_bounds",
    "within_speeds",
]
