"""Tracing: arithmetic on symbols, and the programs made of it."""
