# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Likelihoods and deviations as colours: blue is doubtful, red is sure."""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Colouring:
    """
    What colours show, and on which scale.

    :param by: `likelihood`: the more, the nearer to the last colour; `sigma`: the less
    :param scale: the likelihood that gets the last colour, or the deviation (metres) that gets the
        first one, while 0 gets the last; 0 where there is none
    :param colour_map: one of the choices of Settings.colour_map
    """

    by: str
    scale: float
    colour_map: str

    def colours(
        self, likelihood: NDArray[np.floating], sigma: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """
        Return the colours of points.

        :param likelihood: (n,) in the scale's unit
        :param sigma: (n,) standard deviations, metres; NaN and infinity are as doubtful as can be
        :return: (n, 3) uint8, red green blue
        """
        if self.by == 'sigma':
            return colours(self.scale - sigma, self.scale, self.colour_map)
        return colours(likelihood, self.scale, self.colour_map)

    def edge_colours(
        self, likelihood: NDArray[np.floating], sigma: NDArray[np.floating],
        edges: NDArray[np.int32],
    ) -> NDArray[np.uint8]:
        """
        Return the colours of edges.

        :param likelihood: (k,) of the edges
        :param sigma: (n,) of the vertices, metres: an edge gets the mean of its two
        :param edges: (k, 2) int32, indices of vertices
        :return: (k, 3) uint8, red green blue
        """
        return self.colours(likelihood, sigma[edges].mean(axis=1))


def colours(values: ArrayLike, scale: float, colour_map: str) -> NDArray[np.uint8]:
    """
    Map values to colours.

    :param values: (n,) in any unit
    :param scale: the value that gets the last colour, same unit; 0 where there is none
    :param colour_map: one of the choices of Settings.colour_map
    :return: (n, 3) uint8, red green blue
    """
    levels = np.asarray(values, np.float64) * (255.0 / scale if scale > 0 else 0.0)
    indices = np.clip(np.nan_to_num(levels), 0, 255).astype(np.uint8)
    return _table(colour_map)[indices]


@lru_cache
def _table(colour_map: str) -> NDArray[np.uint8]:
    """Return (256, 3) uint8 colours."""
    from matplotlib import colormaps  # slow to import, and headless users of core may not need it

    table: NDArray[np.uint8] = (
        colormaps[colour_map](np.arange(256), bytes=True)[:, :3].astype(np.uint8))
    return table
