"""Rollouts: many simulated runs of a closed loop with random model errors."""
