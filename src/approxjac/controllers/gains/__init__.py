"""Gains: their values, the rule that chooses them, and the latency that it needs."""
