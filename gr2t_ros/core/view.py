# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One depth image with its camera, its pose and its stamp."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import Camera


@dataclass(frozen=True, eq=False)
class View:
    """
    A depth image that the density can be built from; never changed once made.

    :param depth: (h, w) float32, metres along the optical axis, NaN where invalid
    :param camera: intrinsics of this image, same width and height
    :param T_world_camera: (4, 4) float64, camera (optical frame) to world, metres
    :param stamp_ns: acquisition time, nanoseconds
    :param camera_name: which camera it is of, where there are several
    :param frame_id: of the camera (optical frame)
    """

    depth: NDArray[np.float32]
    camera: Camera
    T_world_camera: NDArray[np.float64]
    stamp_ns: int
    camera_name: str = ''
    frame_id: str = ''
