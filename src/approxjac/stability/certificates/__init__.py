"""Certificates: Theorem 1, its matrix form, the sampled form, and certified starts."""
