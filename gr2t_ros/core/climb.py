# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One step of the way up along a ray.

Newton-Raphson on f (Grogan & Dahyot 2014) is safe only where f'' < 0 and f does not fall;
elsewhere the ray takes the mean-shift step, which always climbs. It stays within its interval.
"""
from __future__ import annotations

from enum import IntEnum
from typing import Any

from numba import from_dtype, njit
import numpy as np
from numpy.typing import NDArray

from .compiled import uncounted

Doubles = NDArray[np.float64]

INTERVAL = 4.0  # h3; the search goes this far from the start
SEEN = 4.0  # h3 between a point and its pixel's depth up to which a view counts as seeing it
MAX_ITERATIONS = 50
_TOLERANCE = 0.04  # h3; a Newton step this short is the last, and good to its cube
_KINK = 0.02  # h3


class Status(IntEnum):
    """How a ray ended."""

    NOT_MARCHED = 0
    CONVERGED = 1
    LEFT_INTERVAL = 2
    NO_SUPPORT = 3
    ITERATION_LIMIT = 4


# A ray on its way, lengths in metres of depth.
#   start, h3    where it set out, and the bandwidth there
#   target       where it wants to know the density next
#   beta         the best place so far, with the density's value and derivatives there, and the g
#                that makes first / g the mean-shift step
#   careful      whether the target is the cautious one
#   stretch      mean-shift steps in a row grow by this: between two humps they are tiny
#   status       a Status; NOT_MARCHED while it goes on
#   evaluations  of the density so far
CLIMBER: Any = from_dtype(np.dtype([
    ('start', 'f8'), ('h3', 'f8'), ('target', 'f8'), ('beta', 'f8'), ('value', 'f8'),
    ('first', 'f8'), ('second', 'f8'), ('g', 'f8'), ('stretch', 'f8'), ('careful', 'i8'),
    ('status', 'i8'), ('evaluations', 'i8')]))


@uncounted()
def set_out(ray: Any, start: float, h3: float) -> None:
    """Put a ray at its start."""
    ray.start, ray.h3 = start, h3
    ray.target, ray.beta = start, start
    ray.value, ray.first, ray.second, ray.g = 0.0, 0.0, 0.0, 1.0
    ray.stretch = 0.5
    ray.careful, ray.status, ray.evaluations = 0, 0, 0


@uncounted(error_model='numpy')
def climb(ray: Any, value: float, first: float, second: float, g: float) -> None:
    """
    Take in the density at the ray's target and choose the next, or end.

    :param ray: a CLIMBER
    :param value: f at the target, with f', f'' and the mean-shift's g
    """
    h3 = ray.h3
    low, high = ray.start - INTERVAL * h3, ray.start + INTERVAL * h3
    ray.evaluations += 1
    status = 0 if ray.evaluations < MAX_ITERATIONS else 4
    if value < ray.value and ray.careful == 0:
        # too far: the plain mean-shift step climbs
        step = min(max(ray.first / ray.g, -h3), h3)
        ray.target = min(max(ray.beta + step, low), high)
        ray.careful, ray.stretch, ray.status = 1, 0.5, status
        return
    beta = ray.target
    # where f' changes sign within the tolerance the maximum is in between: f' may jump there, and
    # then no step gets shorter
    between = (
        ray.value > 0 and ray.first * first < 0 and abs(beta - ray.beta) <= _KINK * h3)
    stretch = ray.stretch
    ray.beta, ray.value, ray.first, ray.second, ray.g = beta, value, first, second, g
    ray.careful, ray.stretch = 0, 0.5
    if value <= 0:
        ray.status = 3
        return
    if between:
        ray.status = 1
        return
    newton = second < 0
    if newton:
        step = -first / second
        if abs(step) <= _TOLERANCE * h3 and low <= beta + step <= high:
            ray.beta, ray.value, ray.status = beta + step, value + 0.5 * first * step, 1
            return
    else:
        ray.stretch = 2.0 * stretch
        step = ray.stretch * first / g
    ray.target = min(max(beta + min(max(step, -h3), h3), low), high)
    ray.status = 2 if ray.target == beta else status


@njit(cache=True, nogil=True)
def h3_at(bandwidth: tuple[float, float, float], depth: float) -> float:
    """Return h3 = max(constant + quadratic z^2, floor), metres."""
    return max(bandwidth[0] + bandwidth[1] * depth * depth, bandwidth[2])


@njit(cache=True, nogil=True)
def aim(table: Doubles, T_world_camera: Doubles, pixel: int, direction: Doubles) -> None:
    """Write the world direction of a pixel's ray, as long as makes the distance the depth."""
    v, u = divmod(pixel, table.shape[1])
    a, b = table[v, u, 0], table[v, u, 1]
    for n in range(3):
        direction[n] = (
            a * T_world_camera[n, 0] + b * T_world_camera[n, 1] + T_world_camera[n, 2])
