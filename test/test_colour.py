# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Colours run from blue to red, whatever the values."""
from dataclasses import fields

import numpy as np
import pytest

from gr2t_ros.core.colour import Colouring, colours
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


def test_a_small_deviation_is_red_and_an_unknown_one_blue():
    colouring = Colouring('sigma', 2e-3, 'turbo')
    sigma = np.float32([0, 1e-3, 2e-3, 1.0, np.inf, np.nan])
    out = colouring.colours(np.zeros(6, np.float32), sigma)
    np.testing.assert_array_equal(out, colours([1, 0.5, 0, 0, 0, 0], 1.0, 'turbo'))
    edges = np.array([[0, 2], [1, 1]], np.int32)
    np.testing.assert_array_equal(
        colouring.edge_colours(np.zeros(2, np.float32), sigma, edges), out[[1, 1]])


def test_likelihoods_have_their_own_colours():
    colouring = Colouring('likelihood', 2.0, 'jet')
    likelihood, sigma = np.float32([0.5, 1.5]), np.float32([0.1, 0.1])
    expected = colours(likelihood, 2.0, 'jet')
    np.testing.assert_array_equal(colouring.colours(likelihood, sigma), expected)
    edges = np.array([[0, 1], [1, 0]], np.int32)
    np.testing.assert_array_equal(colouring.edge_colours(likelihood, sigma, edges), expected)
