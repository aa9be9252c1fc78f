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
    is_near_singular,
    right_pinv,
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

__all__ = [
    "SINGULAR_RATIO",
    "Linear",
    "LinearLaw",
    "Saturation",
    "Sine",
    "Tanh",
    "V",
    "W",
    "adaptive_closed_loop_matrix",
    "allowed_p",
    "allowed_p_at_crossing",
    "allowed_p_position",
    "allowed_p_velocity",
    "best_alpha",
    "bounded_torque",
    "bounded_torque_bound",
    "closed_loop_matrix",
    "cross_weight_damped",
    "cross_weight_pinv",
    "damped_gram_solve",
    "decrease_matrix",
    "dissipation",
    "estimated_velocity_torque",
    "frame_map",
    "gravity",
    "inertial_block",
    "is_near_singular",
    "jacobian_error",
    "lambda_2",
    "largest_allowed_p",
    "largest_alpha",
    "learning_gain",
    "learnt_gravity_torque",
    "limited_torque",
    "measured_velocity_torque",
    "parameter_potential",
    "passive_output",
    "potential_matrix",
    "right_pinv",
    "stiffness_block",
    "theta_hat_rate",
    "within_bounds",
]
