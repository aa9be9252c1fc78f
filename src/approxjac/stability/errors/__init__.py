"""Model errors: their sets, regions of configurations, and coordinates of errors."""
