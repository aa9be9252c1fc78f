"""Limits of torques, joints and motion, and the controller that keeps them."""
