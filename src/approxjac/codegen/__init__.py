"""Code generated from the equations of `law`: traced once, emitted as NumPy, SIMD lanes or C."""

from approxjac.codegen.backends.c_files import export_c as export_c
from approxjac.codegen.step import compiled as compiled
