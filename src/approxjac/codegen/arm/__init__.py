"""A robot, its tasks and cameras on traced arithmetic."""
