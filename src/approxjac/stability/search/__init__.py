"""Searches: for gains, for the largest tolerated error, and maps over errors."""
