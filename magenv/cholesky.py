"""Small dense linear algebra: Gram matrix, Cholesky factor and solution, products, without any allocation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.kernels import kernel

Floats = NDArray[np.float64]


@kernel
def factorise(a: Floats) -> bool:
    """Turn the lower half of ``a`` into its Cholesky factor, inverse diagonal; return False where there is none."""
    n = len(a)
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / math.sqrt(pivot)
        a[j, j] = inverse
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total * inverse
    return True


@kernel
def solve(factor: Floats, b: Floats) -> None:
    """Solve for ``b`` in place."""
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] *= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= factor[k, i] * b[k]
        b[i] *= factor[i, i]


@kernel
def gram(a: Floats, out: Floats) -> None:
    """Write the lower half of a^T a for ``a`` (10, n); written out, so that the loop over j is vectorised."""
    for i in range(len(out)):
        for j in range(i + 1):
            first = a[0, i] * a[0, j] + a[1, i] * a[1, j] + a[2, i] * a[2, j] + a[3, i] * a[3, j] + a[4, i] * a[4, j]
            second = a[5, i] * a[5, j] + a[6, i] * a[6, j] + a[7, i] * a[7, j] + a[8, i] * a[8, j] + a[9, i] * a[9, j]
            out[i, j] = first + second


@kernel
def add_product(a: Floats, b: Floats, out: Floats) -> None:
    """Add a b to ``out`` (n, m), of ``a`` (n, k) and ``b`` (k, m)."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            by = a[i, k]
            for j in range(b.shape[1]):
                out[i, j] += by * b[k, j]


@kernel
def add_transposed_product(a: Floats, b: Floats, out: Floats) -> None:
    """Add a^T b to ``out`` (n, m), of ``a`` (k, n) and ``b`` (k, m)."""
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            by = a[k, i]
            if by != 0.0:  # much of a Jacobian is empty
                for j in range(b.shape[1]):
                    out[i, j] += by * b[k, j]
