"""Backends: a program as LLVM lanes or C99, or carried out by NumPy."""
