"""Code generated from the equations of `law`: traced once, emitted as NumPy, SIMD lanes or C."""

from approxjac.codegen.backends.c_files import export_c
from approxjac.codegen.step import compiled

__all__ = ["compiled", "export_c"]
