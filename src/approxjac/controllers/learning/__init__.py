"""Estimators: kinematics that learn from the measured task value."""
