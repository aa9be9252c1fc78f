"""Functions over the equations of `law`, compiled to machine code by Numba, the extra `fast`.

The equations stay where they are, in `law`: Numba compiles the very functions that NumPy runs.
"""

from __future__ import annotations

import functools
import hashlib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from approxjac import law
from approxjac.extras import package_of
from approxjac.law import products, pseudoinverse, saturation
from approxjac.validation import Array

_EQUATIONS = (
    law.damped_gram_solve,
    law.estimated_velocity_torque,
    law.gravity,
    law.is_near_singular,
    law.learnt_gravity_torque,
    law.passive_output,
    law.theta_hat_rate,
    pseudoinverse._surely_regular,
    saturation.angle,
    saturation.sine,
    saturation.tanh,
)


@functools.cache
def compiled(
    function: Callable[..., Any],
    inputs: tuple[int, ...],
    outputs: int,
    parts: tuple[Callable[..., Any], ...],
) -> Callable[..., Any]:
    """Return `function` as machine code, which any arrays of float64 may be given to.

    It is compiled once on a machine, in some ten seconds, and kept beside its source (or where
    Numba keeps what it may not write there); later it is loaded in about a second a process.

    Args:
        function: What calls nothing but equations of `law`, `parts`, and what Numba knows.
        inputs: For each of its first arguments the number of dimensions: of an array, or 0 for a
            number.
        outputs: How many vectors follow, which it writes into.
        parts: Functions beside it that it calls.

    Raises:
        MissingPackageError: Numba is not installed.
    """
    numba = package_of("fast", "numba")
    _teach((*_EQUATIONS, *parts))
    # Numba looks at the file of a function alone to tell whether what it kept is still true.
    named = types.FunctionType(function.__code__, function.__globals__, function.__name__)
    named.__qualname__ = f"{function.__qualname__}_{_digest(inputs)}"
    signature = [
        numba.types.Array(numba.float64, ndim, "A", readonly=True, aligned=False)
        if ndim
        else numba.float64
        for ndim in inputs
    ]
    signature += [numba.types.Array(numba.float64, 1, "C")] * outputs
    options = {"error_model": "numpy"}  # no exceptions where NumPy has none
    code: Callable[..., Any]
    try:
        code = numba.njit([tuple(signature)], cache=True, **options)(named)
    except Exception:  # no place where it may be kept, no room there, or a file that is damaged
        code = numba.njit([tuple(signature)], **options)(named)
    return code


@functools.cache
def _teach(functions: tuple[Callable[..., Any], ...]) -> None:
    """Tell Numba which functions of this library it may compile."""
    from numba.extending import overload, register_jitable

    for function in functions:
        register_jitable(function)
    overload(products.dot)(product_of)


def _digest(inputs: tuple[int, ...]) -> str:
    """Short name of the equations as they are now, and of what is handed over."""
    sources = sorted(Path(products.__file__).parent.glob("*.py"))
    text = b"".join(source.read_bytes() for source in [*sources, Path(__file__)])
    return hashlib.sha256(text + repr(inputs).encode()).hexdigest()[:12]


def product_of(a: Array, b: Array) -> Callable[[Array, Array], Array] | None:
    """Return `products.dot` for machine code, by the dimensions of its arguments.

    BLAS, which Numba would call, takes longer than loops for arrays as small as a step's.
    """
    return {(2, 1): matrix_vector, (1, 2): vector_matrix, (2, 2): matrix_matrix}.get(
        (a.ndim, b.ndim)
    )


def matrix_vector(a: Array, b: Array) -> Array:
    """`a @ b`, shapes (k, l) and (l,)."""
    product = np.empty(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(a.shape[1]):
            total += a[i, j] * b[j]
        product[i] = total
    return product


def vector_matrix(a: Array, b: Array) -> Array:
    """`a @ b`, shapes (k,) and (k, l)."""
    product = np.zeros(b.shape[1])
    for i in range(b.shape[0]):
        for j in range(b.shape[1]):
            product[j] += a[i] * b[i, j]
    return product


def matrix_matrix(a: Array, b: Array) -> Array:
    """`a @ b`, shapes (k, l) and (l, n)."""
    product = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            for k in range(a.shape[1]):
                product[i, j] += a[i, k] * b[k, j]
    return product
