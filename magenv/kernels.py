"""How the numerical kernels are compiled: ahead of first use, cached on disk, in IEEE arithmetic."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])
Number = TypeVar("Number", bool, int)


_CONSTANTS = ("params", "kernels", "lanes")
"""Modules without kernels of which the machine code depends."""


def _cache_dir() -> Path:
    """Return a cache folder named after the content of all sources.

    Numba renews a cached function when its own file changes, not when a file whose kernels it calls does; one folder
    per state of the sources can never serve stale physics.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.glob("*.py")):
        text = source.read_bytes()
        if b"@kernel" in text or b"@law" in text or source.stem in _CONSTANTS:
            digest.update(source.name.encode() + b"\0" + text)
    root = Path(os.environ.get("NUMBA_CACHE_DIR") or package / "__pycache__")
    if not os.access(package, os.W_OK) and "NUMBA_CACHE_DIR" not in os.environ:
        root = Path.home() / ".cache" / "magenv"
    return root / f"kernels-{digest.hexdigest()[:16]}"


_CACHE_DIR = str(_cache_dir())


def _compile(function: Function, inlined: bool) -> Function:
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = _CACHE_DIR
    try:
        compiled: Any = numba.njit(cache=True, error_model="numpy", nogil=True, forceinline=inlined)(function)
    finally:
        config.CACHE_DIR = before
    return cast("Function", compiled)


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on first use and keep the machine code on disk.

    ``error_model="numpy"``: a division by zero gives infinity or NaN, as in numpy, instead of an exception. No fast
    mathematics, contraction of products and sums included: NaN and infinity stay visible, and scalar and batched calls
    give the same bits. Kernels release the interpreter lock, so that threads may share a batch.
    """
    return _compile(function, inlined=False)


def law(function: Function) -> Function:
    """Compile a small kernel as ``kernel`` does, and make it part of every loop that calls it.

    Only so can LLVM vectorise the loop; the law still stands once.
    """
    return _compile(function, inlined=True)


def typed(value: Number) -> Number:
    """Return a constant as a value of its type: a literal is a type of its own, for which all is compiled anew."""
    return cast("Number", np.bool_(value) if isinstance(value, bool) else np.int64(value))


def _wide_vectors(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # llvmlite lists the attributes it knows, but writes out others as well.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


wide_vectors = cast("Callable[[], None]", intrinsic(_wide_vectors))
"""Let LLVM use vectors of 512 bits in the kernel that calls this, where the processor has them.

By default it takes 256 bits at most, for the sake of programs in which few vectors stand among other work.
"""
