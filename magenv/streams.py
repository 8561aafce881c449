"""Random numbers inside kernels: streams that are fixed by a key, whoever draws from them and in whatever order."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magenv.angles import sincos
from magenv.kernels import law

Keys = NDArray[np.uint64]

_GOLDEN, _MIX_1, _MIX_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@law
def uniform(stream: Keys, low: float, high: float) -> float:
    """Return a number from [low, high) of the stream (1,): SplitMix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    stream[0] += _GOLDEN
    z = stream[0]
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    z = z ^ (z >> _S31)
    return low + (high - low) * (float(z >> _S11) * 2.0**-53)


@law
def normal(stream: Keys, deviation: float) -> float:
    """Return a normally distributed number of mean zero (Box and Muller, 1958)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(stream, 0.0, 1.0)))
    _, cosine = sincos(uniform(stream, 0.0, 2.0 * math.pi))
    return deviation * radius * cosine


@law
def open_stream(stream: Keys, key: int, number: int) -> None:
    """Begin the ``number``-th of the streams of a key in ``stream`` (1,); their states are far from each other."""
    z = np.uint64(key) + np.uint64(number + 1) * _MIX_1
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    stream[0] = z ^ (z >> _S31)
