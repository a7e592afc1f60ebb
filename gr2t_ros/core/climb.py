# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One step of the way up along a ray.

Newton-Raphson on f (Grogan & Dahyot 2014) is safe only where f'' < 0 and f does not fall;
elsewhere the ray takes the mean-shift step, which always climbs. It stays within its interval.
"""
from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from numba import njit
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

INTERVAL = 4.0  # h3; the search goes this far from the start
MAX_ITERATIONS = 50
_TOLERANCE = 0.02  # h3; a Newton step this short is the last, and good to its cube


class Status(IntEnum):
    """How a ray ended."""

    NOT_MARCHED = 0
    CONVERGED = 1
    LEFT_INTERVAL = 2
    NO_SUPPORT = 3
    ITERATION_LIMIT = 4


class Climber(NamedTuple):
    """
    A ray on its way, all in units of its depth.

    :param status: a Status; NOT_MARCHED while it goes on
    :param target: where it wants to know the density next
    :param beta: the best place so far, with the density's value, derivatives, and the g that makes
        first / g the mean-shift step
    :param careful: whether the target is the cautious one
    :param stretch: mean-shift steps in a row grow by this: between two humps they are tiny
    """

    status: int
    target: float
    beta: float
    value: float
    first: float
    second: float
    g: float
    careful: bool
    stretch: float


@njit(cache=True, nogil=True)
def set_out(start: float) -> Climber:
    """Return a ray at its start."""
    return Climber(0, start, start, 0.0, 0.0, 0.0, 1.0, False, 0.5)


@njit(cache=True, nogil=True, error_model='numpy')
def climb(
    ray: Climber, start: float, h3: float, value: float, first: float, second: float, g: float
) -> Climber:
    """
    Take in the density at the ray's target and choose the next.

    :param start: where the ray set out, and h3 the bandwidth there
    :param value: f at the target, with f', f'' and the mean-shift's g
    """
    low, high = start - INTERVAL * h3, start + INTERVAL * h3
    if value < ray.value and not ray.careful:
        # too far: the plain mean-shift step climbs
        step = min(max(ray.first / ray.g, -h3), h3)
        return Climber(
            0, min(max(ray.beta + step, low), high), ray.beta, ray.value, ray.first, ray.second,
            ray.g, True, 0.5)
    beta = ray.target
    if value <= 0:
        return Climber(3, beta, beta, value, first, second, g, False, 0.5)
    if ray.value > 0 and ray.first * first < 0 and abs(beta - ray.beta) <= _TOLERANCE * h3:
        # the maximum is in between: f' may jump there, and then no step gets shorter
        return Climber(1, beta, beta, value, first, second, g, False, 0.5)
    newton = second < 0
    stretch = 0.5 if newton else 2.0 * ray.stretch
    step = -first / second if newton else stretch * first / g
    if newton and abs(step) <= _TOLERANCE * h3 and low <= beta + step <= high:
        return Climber(
            1, beta, beta + step, value + 0.5 * first * step, first, second, g, False, 0.5)
    target = min(max(beta + min(max(step, -h3), h3), low), high)
    status = 2 if target == beta else 0
    return Climber(status, target, beta, value, first, second, g, False, stretch)


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
