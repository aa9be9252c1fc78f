"""Estimators: kinematics learnt from the measured task value."""
