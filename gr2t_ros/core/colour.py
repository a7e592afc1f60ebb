# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Likelihoods as colours: low is blue, high is red."""
from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray


def colours(likelihood: ArrayLike, scale: float, colour_map: str) -> NDArray[np.uint8]:
    """
    Map likelihoods to colours.

    :param likelihood: (n,) in any unit
    :param scale: the likelihood that gets the last colour, same unit; 0 where there is none
    :param colour_map: one of the choices of Settings.colour_map
    :return: (n, 3) uint8, red green blue
    """
    levels = np.asarray(likelihood, np.float64) * (255.0 / scale if scale > 0 else 0.0)
    indices = np.clip(np.nan_to_num(levels), 0, 255).astype(np.uint8)
    return _table(colour_map)[indices]


@lru_cache
def _table(colour_map: str) -> NDArray[np.uint8]:
    """Return (256, 3) uint8 colours."""
    from matplotlib import colormaps  # slow to import, and headless users of core may not need it

    table: NDArray[np.uint8] = (
        colormaps[colour_map](np.arange(256), bytes=True)[:, :3].astype(np.uint8))
    return table
