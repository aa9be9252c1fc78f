"""Backends: a program as LLVM lanes, C99 or NumPy source."""
