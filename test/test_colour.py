# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Colours run from blue to red, whatever the values."""
from dataclasses import fields

import numpy as np
import pytest

from gr2t_ros.core.colour import colours
from gr2t_ros.settings import Settings

MAPS = next(f for f in fields(Settings) if f.name == 'colour_map').metadata['choices']


@pytest.mark.parametrize('colour_map', [m for m in MAPS if m != 'viridis'])
def test_low_is_blue_and_high_is_red(colour_map):
    low, high = colours([0.1, 0.9], 1.0, colour_map).astype(int)
    assert low[2] > low[0] and high[0] > high[2]


def test_values_off_the_scale_are_clipped():
    out = colours([-1, 0, 2.0, 4.0, np.inf, np.nan], 2.0, 'turbo')
    assert out.dtype == np.uint8 and out.shape == (6, 3)
    np.testing.assert_array_equal(out[0], out[1])
    np.testing.assert_array_equal(out[2], out[3])
    np.testing.assert_array_equal(out[2], out[4])
    np.testing.assert_array_equal(out[5], out[0])


def test_no_scale_is_the_lowest_colour():
    np.testing.assert_array_equal(colours([3.0], 0.0, 'jet'), colours([0.0], 1.0, 'jet'))
