"""Limits of torques and joints, and the controllers that keep them."""
