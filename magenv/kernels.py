"""How the numerical kernels are compiled: ahead of first use, cached on disk, in IEEE arithmetic."""

from __future__ import annotations

import gc
import hashlib
import os
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core import cgutils, event
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., Any])
Number = TypeVar("Number", bool, int)
Arrays = TypeVar("Arrays", bound=tuple[Any, ...])


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
        njit: Any = numba.njit
        # Wrappers for callers in C, of which there are none, took a fifth of the time of compilation.
        options = {"forceinline": inlined, "no_cfunc_wrapper": True}
        compiled: Any = njit(cache=True, error_model="numpy", nogil=True, **options)(function)
    finally:
        config.CACHE_DIR = before
    _OURS.add(compiled)
    return cast("Function", compiled)


class _Uncollected(event.Listener):
    """Keeps Python from looking for garbage while our kernels compile: that took a tenth of the time, and found little.

    What others compile is left alone. Who disables collection himself meanwhile, in another thread, finds it enabled.
    """

    def __init__(self) -> None:
        self._begin()
        if hasattr(os, "register_at_fork"):  # Windows knows no forks
            os.register_at_fork(after_in_child=self._after_fork)

    def _begin(self) -> None:
        self._lock, self._compiling, self._collected = threading.Lock(), 0, True

    def _after_fork(self) -> None:
        """Forget what another thread was compiling: it is not in the child."""
        if self._compiling > 0 and self._collected:
            gc.enable()
        self._begin()

    def on_start(self, event: Any) -> None:
        """Begin to compile a function, perhaps for the sake of another."""
        if event.data["dispatcher"] in _OURS:
            with self._lock:
                if self._compiling == 0:
                    self._collected = gc.isenabled()
                    gc.disable()
                self._compiling += 1

    def on_end(self, event: Any) -> None:
        """End it."""
        if event.data["dispatcher"] in _OURS:
            with self._lock:
                self._compiling -= 1
                if self._compiling == 0 and self._collected:
                    gc.enable()


_OURS: weakref.WeakSet[Any] = weakref.WeakSet()
event.register("numba:compile", _Uncollected())  # type: ignore[no-untyped-call]


def kernel(function: Function) -> Function:
    """Compile ``function`` with numba on first use and keep the machine code on disk.

    ``error_model="numpy"``: a division by zero gives infinity or NaN, as in numpy, instead of an exception. No fast
    mathematics, contraction of products and sums included: NaN and infinity stay visible, and scalar and batched calls
    give the same bits. What a kernel closes over must not be a kernel: numba would find it on disk never again. Kernels
    release the interpreter lock, so that threads may share a batch.
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


_CACHE_LINE = 64


def _in_cache_lines(typing_context: Any, rows: Any, columns: Any) -> Any:
    array_type = types.Array(types.float64, 2, "C")
    arrays, pack = cast("Any", arrayobj), cast("Any", cgutils).pack_array

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rows, columns = arguments
        item = context.get_constant(types.intp, 8)
        pitch = builder.mul(columns, item)
        align = context.get_constant(types.uint32, _CACHE_LINE)
        meminfo = context.nrt.meminfo_alloc_aligned(builder, builder.mul(rows, pitch), align)
        array = arrays.make_array(array_type)(context, builder)
        arrays.populate_array(
            array,
            data=builder.bitcast(context.nrt.meminfo_data(builder, meminfo), array.data.type),
            shape=pack(builder, (rows, columns)),
            strides=pack(builder, (pitch, item)),
            itemsize=item,
            meminfo=meminfo,
        )
        return array._getvalue()

    return array_type(types.intp, types.intp), generate


in_cache_lines = cast("Callable[[int, int], NDArray[np.float64]]", intrinsic(_in_cache_lines))
"""Return a new array of rows that begin where cache lines do, if they are whole ones long; its numbers are not set.

Numpy's begin anywhere: the hold, whose vectors are a cache line, was up to a tenth slower or not from one run to the
next.
"""


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    """Return an array without its owner, a tuple with all its arrays so, anything else as it is."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = array.meminfo.type(None)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        kinds: Any = kind
        parts = [_without_owner(context, builder, k, builder.extract_value(value, i)) for i, k in enumerate(kinds)]
        return context.make_tuple(builder, kind, parts)
    return value


def _uncounted(typing_context: Any, arrays: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _without_owner(context, builder, arrays, arguments[0])

    return arrays(arrays), generate


uncounted = cast("Callable[[Arrays], Arrays]", intrinsic(_uncounted))
"""Return a tuple, its arrays without owners: counting references to them took a fifth of a short step.

Whoever calls this keeps the arrays alive; a kernel by ``keep``, after all that is done with them.
"""


@law
def keep(arrays: Any) -> None:
    """Do nothing: what is used here is kept until then."""
