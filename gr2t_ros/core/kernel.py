# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One view's window sum: its share of the density at a point, and two derivatives along a line.

With the residuals du = (u_i - U) / h1, dv = (v_i - V) / h1, dz = (z_i - Z) / h3_i of pixel i, the
term of Grogan & Dahyot (2014) is E_i = exp(-(du^2 + dv^2 + dz^2) / 2) / h3_i up to a constant.
Along a line, m_i = du U'/h1 + dv V'/h1 + dz Z'/h3_i gives E_i' = E_i m_i and
E_i'' = E_i (m_i^2 + m_i'); U, V, Z are linear-fractional or worse, so m_i' carries U'' and V''.

Sums run over columns first: a row of the window is one vector operation, and only the column sums
meet the column weights. Depths stay exact: the point's depth is split into two float32, so that
the residual is rounded once.
"""
from __future__ import annotations

from math import ceil, e, log2, sqrt
from typing import NamedTuple

from llvmlite import ir
from numba import float32, int32, njit, types, uint64
from numba.extending import intrinsic
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# residuals are stored times this, so that a kernel is a power of two: exp(-x^2/2) = 2^-(kx)^2
RESIDUAL_SCALE = sqrt(log2(e) / 2)
INVALID_DEPTH = np.float32(1e9)  # m; not NaN, whose comparisons fast arithmetic leaves open

_FAST = {'contract', 'nsz'}  # not reassoc: it would undo the split depth
_K2 = np.float32(RESIDUAL_SCALE ** 2)
_ZERO, _HALF = np.float32(0), np.float32(0.5)
# 2^x on [-1/2, 1/2], interpolated at Chebyshev points: below float32 rounding
_nodes = 0.5 * np.cos(np.pi * (np.arange(7) + 0.5) / 7)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (
    np.float32(c) for c in np.polynomial.polynomial.polyfit(_nodes, 2.0 ** _nodes, 6))


class Window(NamedTuple):
    """
    The part of the image that a point's sum runs over.

    :param bandwidth: h1 = h2, pixels
    :param reach: half width, pixels
    :param lanes: columns, and rows, that it can touch, rounded up to whole vectors
    :param limit: exponent (of two) below which a kernel counts as zero
    """

    bandwidth: float
    reach: float
    lanes: int
    limit: np.float32

    @classmethod
    def of(cls, bandwidth: float, truncation: float) -> Window:
        """Return the window that ends truncation bandwidths from its centre."""
        reach = truncation * bandwidth
        lanes = 8 * ceil((int(2 * reach) + 1) / 8)
        limit = np.float32(-(truncation * RESIDUAL_SCALE) ** 2 * (1 + 1e-6))
        return cls(float(bandwidth), float(reach), lanes, limit)


@intrinsic
def _as_float(typing_context, bits):  # type: ignore[no-untyped-def]
    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], ir.FloatType())
    return types.float32(types.int32), generate


@njit(inline='always')
def _exp2(x: np.float32) -> np.float32:
    """Return 2^x for -126 <= x <= 0; vectorises, as the library's does not."""
    n = np.floor(x + _HALF)
    r = x - n
    p = _C0 + r * (_C1 + r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * _C6)))))
    power = (int32(n) + int32(127)) << int32(23)  # type: ignore[operator]
    return p * _as_float(power)  # type: ignore[call-arg, no-any-return]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model='numpy')
def axis_weights(
    window: Window, centre: float, centre1: float, centre2: float, out: Floats
) -> int:
    """
    Weigh the pixels of one image axis about a moving centre.

    :param centre: pixels, with its two derivatives along the line
    :param out: (3, lanes): the kernel, its part of m, and of m'
    :return: the first pixel of the window
    """
    first = int(np.ceil(centre - window.reach))
    scale = 1.0 / window.bandwidth
    velocity = float32(centre1 * scale)
    acceleration = float32(centre2 * scale)
    k = float32(RESIDUAL_SCALE)
    for i in range(window.lanes):
        a = uint64(i)
        d = float32((first + i - centre) * scale)
        x = -(d * k) * (d * k)
        out[uint64(0), a] = _exp2(x) if x >= window.limit else _ZERO
        out[uint64(1), a] = d * velocity
        out[uint64(2), a] = d * acceleration - velocity * velocity
    return first


@njit(cache=True, nogil=True, fastmath=_FAST, error_model='numpy')
def window_jet(
    depth: Floats, precision: Floats, first: int, stride: int, window: Window,
    z: float, z1: float, columns: Floats, rows: Floats, sums: Floats,
) -> tuple[float, float, float]:
    """
    Sum the kernels of a window and their two derivatives along the line.

    :param depth: flat padded images, metres, INVALID_DEPTH where there is none
    :param precision: RESIDUAL_SCALE / h3 of each pixel, 1/m
    :param first: index of the window's first pixel
    :param stride: of the image's rows
    :param z: the point's depth, metres, and its velocity
    :param columns: (3, lanes) from axis_weights; rows likewise
    :param sums: (3 * lanes,) scratch
    :return: f, f', f'' in units of RESIDUAL_SCALE / m
    """
    lanes = window.lanes
    limit = window.limit
    z_high = float32(z)
    z_low = float32(z - z_high)
    velocity = float32(z1 / (RESIDUAL_SCALE * RESIDUAL_SCALE))
    one = uint64(lanes)
    two = uint64(2 * lanes)
    for i in range(3 * lanes):
        sums[uint64(i)] = _ZERO
    for row in range(lanes):
        r = uint64(row)
        weight = rows[uint64(0), r]
        if weight == _ZERO:
            continue
        m_row = rows[uint64(1), r]
        n_row = rows[uint64(2), r]
        start = uint64(first + row * stride)
        for i in range(lanes):
            a = uint64(i)
            s = precision[start + a]
            dz = ((depth[start + a] - z_high) - z_low) * s
            x = -dz * dz
            kernel = weight * s * (_exp2(x) if x >= limit else _ZERO)
            sz = s * velocity
            m = columns[uint64(1), a] + m_row + dz * sz
            km = kernel * m
            sums[a] += kernel
            sums[a + one] += km
            sums[a + two] += km * m + kernel * (n_row - _K2 * (sz * sz))
    f = 0.0
    f1 = 0.0
    f2 = 0.0
    for i in range(lanes):
        a = uint64(i)
        weight = columns[uint64(0), a]
        f += weight * sums[a]
        f1 += weight * sums[a + one]
        f2 += weight * (sums[a + two] + columns[uint64(2), a] * sums[a])
    return f, f1, f2


@njit(cache=True, nogil=True, fastmath=_FAST, error_model='numpy')
def window_value(
    depth: Floats, precision: Floats, first: int, stride: int, window: Window,
    z: float, columns: Floats, rows: Floats, sums: Floats,
) -> float:
    """Return window_jet's f alone."""
    lanes = window.lanes
    limit = window.limit
    z_high = float32(z)
    z_low = float32(z - z_high)
    for i in range(lanes):
        sums[uint64(i)] = _ZERO
    for row in range(lanes):
        weight = rows[uint64(0), uint64(row)]
        if weight == _ZERO:
            continue
        start = uint64(first + row * stride)
        for i in range(lanes):
            a = uint64(i)
            s = precision[start + a]
            dz = ((depth[start + a] - z_high) - z_low) * s
            x = -dz * dz
            sums[a] += weight * s * (_exp2(x) if x >= limit else _ZERO)
    f = 0.0
    for i in range(lanes):
        f += columns[uint64(0), uint64(i)] * sums[uint64(i)]
    return f
