# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Depth images in units of their own bandwidth.

With t(z) = integral dz / h3(z) the residual of a depth z_i over its bandwidth is t(z_i) - t(Z) to
first order, whatever h3(z) is: one subtraction replaces a bandwidth a pixel. The kernel's factor
1/h3(z_i) is exp(-h3' (t_i - t)) / h3(Z), which moves t(Z) by h3'(Z) and is otherwise constant.
Images hold t / sqrt(32), as vector.window_strip wants it.
"""
from __future__ import annotations

from concurrent.futures import Executor
from math import ceil, sqrt
from typing import NamedTuple

from numba import njit, uint64
import numpy as np
from numpy.typing import NDArray

from .compiled import run_all, uncounted
from .vector import agreement, LANES, window_strip
from .view import View

Floats = NDArray[np.float32]

INVALID = np.float32(1e9)
_SQRT32 = sqrt(32.0)
_PHASES = 256  # sub-pixel positions with weights of their own
_HALF_WIDTH = 2.6  # bandwidths; beyond, the weights are folded into the moments
_SAMPLES = 8192  # of t(z), which goes on some way beyond depth_max
_BEYOND = 1.1
CELL = 4  # px; side of the squares that know their support
SUPPORT = 3.0  # bandwidths along the depth at which a kernel ends
_ROWS = 40 * CELL  # a task
CELL_BITS = 2  # of CELL
BINS = 2.0  # a bandwidth; resolution of the support
_UNWARP = np.float32(BINS * _SQRT32)
_OUTLIER = np.float32(0.2)  # less than this share of the window's best density makes an outlier
_CERTAIN = _OUTLIER + np.float32(0.001)  # more than the kernels' rounding
_NEIGHBOURS = 2  # px; candidates for the robust start come from 5 x 5 pixels


class Scale(NamedTuple):
    """
    t(z) / sqrt(32) at equal steps from depth 0, and what else of h3(z) the kernels need.

    :param table: (n,) float32
    :param per_metre: steps per metre
    :param constant: h3(z) = max(constant + quadratic z^2, floor), metres
    """

    table: Floats
    per_metre: float
    constant: float
    quadratic: float
    floor: float

    @classmethod
    def of(
        cls, constant: float, quadratic: float, floor: float, depth_max: float
    ) -> Scale:
        """Tabulate; depths above depth_max (metres) count as invalid."""
        z = np.linspace(0, _BEYOND * depth_max, _SAMPLES)
        slope = 1 / np.maximum(constant + quadratic * z * z, floor)
        steps = np.diff(z) * (slope[1:] + slope[:-1]) / 2
        t = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(
            (t / _SQRT32).astype(np.float32), float(1 / z[1]), constant, quadratic, floor)

    def depth_of_bins(self) -> NDArray[np.float64]:
        """Return the depth (metres) at which each support bin begins."""
        t = self.table.astype(np.float64) * _SQRT32
        count = int(t[-1] * BINS) + 2
        z = np.arange(len(t)) / self.per_metre
        return np.interp(np.arange(count) / BINS, t, z)


class Weights(NamedTuple):
    """
    The lateral kernel at sub-pixel positions.

    :param table: flat (phases, lanes) float32; each row sums to 1 and has the mean and the
        variance of the Gaussian, and nearly its fourth moment, though it ends after lanes pixels
    :param lanes: pixels on each axis
    """

    table: Floats
    lanes: int

    @classmethod
    def of(cls, bandwidth: float) -> Weights:
        """Return the weights of a bandwidth in pixels."""
        lanes = LANES * ceil(2 * _HALF_WIDTH * bandwidth / LANES)
        phase = (np.arange(_PHASES) + 0.5) / _PHASES
        d = np.arange(lanes) - (lanes // 2 - 1) - phase[:, None]
        powers = d[:, None, :] ** np.arange(9)[:, None]
        gauss = np.exp(-0.5 * (d / bandwidth) ** 2)
        moments = np.einsum('pkl,pl->pk', powers, gauss)
        wanted = np.array([1.0, 0.0, bandwidth ** 2, 0.0, 3 * bandwidth ** 4])
        table = np.zeros_like(d)
        # with the fourth moment the error at steep slopes has the other sign: half of each
        for count in (3, 5):
            order = np.arange(count)
            factors = np.linalg.solve(
                moments[:, np.add.outer(order, order)],
                np.tile(wanted[:count], (_PHASES, 1))[..., None])[..., 0]
            table += 0.5 * gauss * np.einsum('pkl,pk->pl', powers[:, :count], factors)
        return cls(table.astype(np.float32).ravel(), lanes)


class Warped(NamedTuple):
    """
    A depth image ready for window_strip.

    :param image: flat padded image of t / sqrt(32), INVALID where there is none
    :param stride: of its rows
    :param pad: pixels before the first, on both axes
    :param low: (rows, columns) int32, the least support bin in each cell of CELL x CELL pixels,
        2^30 where there is none; high: the largest, -1
    :param valid: pixels that have a depth
    """

    image: Floats
    stride: int
    pad: int
    low: NDArray[np.int32]
    high: NDArray[np.int32]
    valid: int


class Support(NamedTuple):
    """
    Where a view's kernels are, by cells of CELL x CELL pixels, row by row.

    Bit k of a cell says that pixels about it have kernels in the bins base + (k << shift) on. One
    more cell, the last, is empty.

    :param columns: cells in a row
    """

    base: NDArray[np.int32]
    shift: NDArray[np.int32]
    mask: NDArray[np.uint64]
    columns: int


def warped(
    view: View, scale: Scale, weights: Weights, pool: Executor | None = None,
    reuse: Warped | None = None,
) -> Warped:
    """
    Return a view's depth image in units of its bandwidth.

    :param pool: where to do it; None: in this thread
    :param reuse: an image that is no longer needed; where it is as large this one takes its place
    """
    height, width = view.depth.shape
    pad = 2 * weights.lanes + CELL
    whole = (height + 2 * pad, width + 2 * pad)
    if reuse is not None and reuse.stride == whole[1] and reuse.image.size == whole[0] * whole[1]:
        image = reuse.image.reshape(whole)
    else:
        image = np.full(whole, INVALID)
    shape = (-(-height // CELL), -(-width // CELL))
    low, high = np.full(shape, 2 ** 30, np.int32), np.full(shape, -1, np.int32)
    # without a ray a pixel has no place in space
    depth = view.depth
    if view.camera.has_blind_pixels:
        depth = np.where(np.isnan(view.camera.rays[..., 0]), np.float32(np.nan), depth)
    depth = np.ascontiguousarray(depth)
    valid = run_all(pool, _warp, [
        (depth, scale, pad, image, low, high, row, min(row + _ROWS, height))
        for row in range(0, height, _ROWS)])
    return Warped(image.ravel(), image.shape[1], pad, low, high, sum(valid))


@uncounted(error_model='numpy')
def _warp(
    depth: Floats, scale: Scale, pad: int, image: Floats, low: NDArray[np.int32],
    high: NDArray[np.int32], first: int, end: int,
) -> int:
    table, per_metre = scale.table, np.float32(scale.per_metre)
    last = np.float32((len(table) - 1) / _BEYOND * 1.00001)
    valid = 0
    for v in range(first, end):
        for u in range(depth.shape[1]):
            at = depth[v, u] * per_metre
            image[v + pad, u + pad] = INVALID
            if np.float32(0) < at <= last:
                i = int(at)
                t = table[i] + (at - np.float32(i)) * (table[i + 1] - table[i])
                image[v + pad, u + pad] = t
                bin_ = np.int32(t * _UNWARP)
                row, column = v >> CELL_BITS, u >> CELL_BITS
                low[row, column] = min(low[row, column], bin_)
                high[row, column] = max(high[row, column], bin_)
                valid += 1
    return valid


def empty_support(height: int, width: int) -> Support:
    """Return the support of an image before find_support fills it in."""
    rows, columns = -(-height // CELL), -(-width // CELL)
    cells = rows * columns + 1
    return Support(
        np.zeros(cells, np.int32), np.zeros(cells, np.int32), np.zeros(cells, np.uint64), columns)


@njit(cache=True, nogil=True)
def find_support(
    warped_image: Warped, height: int, width: int, lanes: int, support: Support, first: int,
    end: int,
) -> None:
    """
    Fill in the support of rows of cells, from first to end.

    :param lanes: of the weights: a pixel counts for points half of that away
    """
    columns = support.columns
    _find_support(
        warped_image, height, width, lanes, support, first, end,
        np.zeros(columns, np.int32), np.zeros(columns, np.int32))


@njit(inline='always')
def _bits(first: int, last: int, shift: int) -> np.uint64:
    """Return a mask of the bins from first to last, of 2^shift each."""
    a, b = uint64(first >> shift), uint64(last >> shift)
    return ((uint64(2) << (b - a)) - uint64(1)) << a


@uncounted()
def _find_support(
    warped_image: Warped, height: int, width: int, lanes: int, support: Support, first: int,
    end: int, low_of: NDArray[np.int32], high_of: NDArray[np.int32],
) -> None:
    """
    Find_support.

    :param low_of: scratch: the least bins about a row, by columns; high_of: the largest
    """
    image, stride, pad = warped_image.image, warped_image.stride, warped_image.pad
    rows, columns = warped_image.low.shape
    about = -(-lanes // (2 * CELL))
    reach = int(np.ceil(SUPPORT * BINS))
    for j in range(first, end):
        low_of[:] = 2 ** 30
        high_of[:] = -1
        for row in range(max(j - about, 0), min(j + about + 1, rows)):
            for i in range(columns):
                low_of[i] = min(low_of[i], warped_image.low[row, i])
                high_of[i] = max(high_of[i], warped_image.high[row, i])
        for i in range(columns):
            low, high = 2 ** 30, -1
            for column in range(max(i - about, 0), min(i + about + 1, columns)):
                low, high = min(low, low_of[column]), max(high, high_of[column])
            cell = j * columns + i
            support.mask[cell] = uint64(0)
            if high < 0:
                continue
            base = low - reach
            span = high + reach - base
            shift = 0
            while (span >> shift) > 62:
                shift += 1
            mask = uint64(0)
            if high - low <= 2 * reach:
                # one surface: no gap that a bin would show
                mask = (uint64(2) << uint64(span >> shift)) - uint64(1)
            else:
                for row in range(max(j - about, 0), min(j + about + 1, rows)):
                    for column in range(max(i - about, 0), min(i + about + 1, columns)):
                        low = warped_image.low[row, column]
                        high = warped_image.high[row, column]
                        if high < 0:
                            continue
                        if high - low <= 2 * reach:
                            mask |= _bits(low - reach - base, high + reach - base, shift)
                            continue
                        for v in range(CELL * row, min(CELL * (row + 1), height)):
                            for u in range(CELL * column, min(CELL * (column + 1), width)):
                                t = image[(v + pad) * stride + u + pad]
                                if t != INVALID:
                                    low = int(t * _UNWARP) - reach - base
                                    mask |= _bits(low, low + 2 * reach, shift)
            support.base[cell] = base
            support.shift[cell] = shift
            support.mask[cell] = mask


@njit(cache=True, nogil=True)
def robust_starts(
    warped_image: Warped, weights: Weights, width: int, depth: Floats,
    pixels: NDArray[np.int32], starts: Floats,
) -> None:
    """
    Replace observed depths that their own image contradicts.

    The candidates are the depths of the 5 x 5 neighbours; each is weighed by the view's own
    density on the ray there, without the kernel of the pixel that proposes it.

    :param depth: (h w,) float32, metres
    :param pixels: (n,) flat pixel indices, ascending
    :param starts: (n,) float32, metres: the observed depths; outliers are replaced
    """
    _robust_starts(
        warped_image, weights, width, depth, pixels, starts, np.zeros(LANES, np.float32))


@uncounted()
def _robust_starts(
    warped_image: Warped, weights: Weights, width: int, depth: Floats,
    pixels: NDArray[np.int32], starts: Floats, agreeing: Floats,
) -> None:
    image, stride, pad = warped_image.image, warped_image.stride, warped_image.pad
    weight = weights.table
    lanes = weights.lanes
    half = lanes // 2 - 1
    beside = -LANES  # the first of the pixels that `agreeing` speaks of
    v, line = 0, 0  # line: flat index of its first pixel
    for n in range(len(pixels)):
        while pixels[n] >= line + width:
            v, line = v + 1, line + width
        centre = (v + pad) * stride + pixels[n] - line + pad
        if image[centre] == INVALID:
            continue
        if not 0 <= centre - beside < LANES:
            beside = centre
            agreement(image, beside, stride, weight, half, agreeing)
        if agreeing[centre - beside] >= _CERTAIN:
            continue
        observed = _share(image, stride, weight, lanes, centre, image[centre])
        observed -= weight[half] * weight[half]
        if observed >= _OUTLIER:
            continue  # no depth can have more than 1
        best, best_pixel = observed, pixels[n]
        for row in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
            for column in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
                at = centre + row * stride + column
                if image[at] == INVALID or at == centre:
                    continue
                share = _share(image, stride, weight, lanes, centre, image[at])
                share -= weight[half + row] * weight[half + column]
                if share > best:
                    best, best_pixel = share, pixels[n] + row * width + column
        if observed < _OUTLIER * best:
            starts[n] = depth[best_pixel]


@uncounted()
def _share(
    image: Floats, stride: int, weight: Floats, lanes: int, centre: int, at: np.float32
) -> np.float32:
    """Return the image's own density on a pixel's ray, as a share of the most there can be."""
    first = centre - (lanes // 2 - 1) * (stride + 1)
    share = np.float32(0)
    for strip in range(0, lanes, LANES):
        share += window_strip(image, first + strip, stride, weight, 0, lanes, weight, strip, at)
    return share
