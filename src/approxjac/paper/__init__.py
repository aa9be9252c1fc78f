"""The paper's two-link study: Figures 1 and 3–8, from the URDF through Pinocchio."""

from approxjac.paper.experiments import (
    ALPHA,
    CAMERA,
    EXPERIMENTS,
    LEARNING_GAIN,
    LENGTHS,
    Setup,
    build,
    build_arm,
)
from approxjac.paper.reproduction import REPORT_TIMES, Reproduction, jacobian_bound, run_experiment

__all__ = [
    "ALPHA",
    "CAMERA",
    "EXPERIMENTS",
    "LEARNING_GAIN",
    "LENGTHS",
    "REPORT_TIMES",
    "Reproduction",
    "Setup",
    "build",
    "build_arm",
    "jacobian_bound",
    "run_experiment",
]
