# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Transforms that jump, as where SLAM corrects itself."""
from __future__ import annotations

from collections import deque

import numpy as np

from ..core.poses import Pose, step

_DISTANCE, _ANGLE = 0.05, 0.05  # m, rad: smaller steps are noise
_ACCELERATION = 10.0  # m/s^2 or rad/s^2: what a hand does at most
_LONGEST = 0.2  # s between poses for which that is taken into account
_SHORTEST_NS = 10_000_000  # between poses; those that come faster are passed over
_RATIO = 3.0  # of a jump to the steps before and after it
_SAMPLES = 4


class JumpWatch:
    """Looks at the stamped poses of one thing for a step that none before or after it is like."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, Pose]] = deque(maxlen=_SAMPLES)

    def add(self, stamp_ns: int, T: Pose) -> tuple[float, float] | None:
        """
        Take a pose.

        :param stamp_ns: nanoseconds; poses that are not later than the last start anew
        :param T: (4, 4) float64
        :return: metres and radians of a jump, once the pose after it has come
        """
        if self._poses and 0 < stamp_ns - self._poses[-1][0] < _SHORTEST_NS:
            return None
        if not np.isfinite(T).all() or (self._poses and stamp_ns <= self._poses[-1][0]):
            self._poses.clear()
        self._poses.append((stamp_ns, T))
        if len(self._poses) < _SAMPLES:
            return None
        stamps = np.array([stamp for stamp, _ in self._poses])
        spans = np.diff(stamps) * 1e-9
        steps = np.array([step(a, b) for (_, a), (_, b) in zip(
            self._poses, list(self._poses)[1:])])
        before, jump, after = steps
        # neighbours as if they had lasted as long
        usual = np.maximum(before * spans[1] / spans[0], after * spans[1] / spans[2])
        moved = _ACCELERATION * min(spans[1], _LONGEST) ** 2
        limit = np.maximum([_DISTANCE, _ANGLE], moved)
        if not ((jump > limit) & (jump > _RATIO * usual)).any():
            return None
        return float(jump[0]), float(jump[1])
