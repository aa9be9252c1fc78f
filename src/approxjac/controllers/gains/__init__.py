"""Gains: their values, the rule that chooses them, and what it needs to know of the loop."""
