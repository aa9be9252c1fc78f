"""Tracing: arithmetic on numbers that are not known yet, and the programs made of it."""
