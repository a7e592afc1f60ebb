# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The vector kernels compute the plain sums they stand for."""
from numba import njit
import numpy as np
import pytest

from gr2t_ros.core.vector import LANES, ROW, SPLINE, spline_jet, window_strip


@njit
def strip_of(image, first, stride, rows, row, count, columns, column, at):
    return window_strip(image, first, stride, rows, row, count, columns, column, at)


@njit
def jet_of(coefficients, bases, x, y, z, at, along):
    return spline_jet(
        coefficients, bases, x, y, z, at[0], at[1], at[2], along[0], along[1], along[2])


@pytest.mark.parametrize('count', [8, 16, 24])
def test_a_strip_is_the_plain_sum(count):
    rng = np.random.default_rng(count)
    stride, first = 40, 3 * 40 + 5
    image = rng.uniform(-1.5, 1.5, (40, stride)).astype(np.float32)
    image[rng.random(image.shape) < 0.1] = 1e9  # invalid
    rows, columns = (rng.random(n).astype(np.float32) for n in (count + 3, LANES + 2))
    rows /= rows[3:].sum()
    columns /= columns[2:].sum()
    window = image[3:3 + count, 5:5 + LANES].astype(float)
    for at in np.float32([-1.0, 0.0, 0.3]):
        kernels = np.exp(-16 * (window - at) ** 2)
        found = strip_of(image.ravel(), first, stride, rows, 3, count, columns, 2, at)
        assert found == pytest.approx(rows[3:] @ kernels @ columns[2:], abs=3e-4)


def test_what_is_far_counts_for_nothing():
    image = np.full(100, 1e9, np.float32)
    even = np.full(8, 1 / 8, np.float32)
    assert 0 <= strip_of(image, 0, 8, even, 0, 8, even, 0, np.float32(0)) < 5e-6
    image[:] = 0.25  # one and a half bandwidths: exp(-16 x^2) at sqrt(32) x = 1.414
    found = strip_of(image, 0, 8, even, 0, 8, even, 0, np.float32(0))
    assert found == pytest.approx(np.exp(-1), abs=3e-4)


def weights(at, along):
    """Return the four taps' weights with two derivatives along the ray, (3, 4)."""
    powers = at ** np.arange(4)
    first = np.arange(4) * np.concatenate([[0], powers[:3]])
    second = np.array([0, 0, 2, 6 * at])
    return np.stack([powers @ SPLINE, along * (first @ SPLINE), along ** 2 * (second @ SPLINE)])


def blocks_of(dense):
    """Return (16, 16, 16) coefficients as 8 blocks, and where the four kinds of them begin."""
    blocks = np.zeros((2, 2, 8, 8, ROW), np.float32)
    for z in range(2):
        for y in range(2):
            part = dense[8 * z:8 * z + 8, 8 * y:8 * y + 8]
            blocks[z, y, :, :, :11] = part[..., :11]
    return blocks.ravel(), np.arange(4) * 64 * ROW


def test_a_jet_is_the_plain_tensor_product_across_blocks():
    rng = np.random.default_rng(0)
    dense = rng.normal(size=(16, 16, 16)).astype(np.float32)
    flat, bases = blocks_of(dense)
    for _ in range(100):
        x, y, z = rng.integers(0, 8, 3)
        at = rng.random(3).astype(np.float32)
        along = rng.normal(size=3).astype(np.float32)
        wx, wy, wz = (weights(float(a), float(d)) for a, d in zip(at, along))
        taps = dense[z:z + 4, y:y + 4, x:x + 4].astype(float)
        terms = np.einsum('zyx,iz,jy,kx->ijk', taps, wz, wy, wx)
        order = np.sum(np.mgrid[:3, :3, :3], axis=0)
        twice = np.max(np.mgrid[:3, :3, :3], axis=0) == 2
        expected = [
            terms[0, 0, 0], terms[order == 1].sum(),
            terms[(order == 2) & twice].sum() + 2 * terms[(order == 2) & ~twice].sum()]
        found = jet_of(flat, bases, x, y, z, at, along)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_derivatives_are_those_of_the_value():
    rng = np.random.default_rng(1)
    flat, bases = blocks_of(rng.normal(size=(16, 16, 16)).astype(np.float32))
    along = np.float32([0.5, -0.7, 0.3])
    step = 0.02
    values = [
        jet_of(flat, bases, 6, 2, 7, np.float32([0.4, 0.5, 0.6]) + np.float32(k * step) * along,
               along) for k in (-1, 0, 1)]
    f = [value[0] for value in values]
    assert values[1][1] == pytest.approx((f[2] - f[0]) / (2 * step), abs=2e-3)
    assert values[1][2] == pytest.approx((values[2][1] - values[0][1]) / (2 * step), abs=5e-3)


def test_constants_and_linear_functions_are_reproduced():
    z, y, x = np.mgrid[:16, :16, :16]
    for dense, gradient in (
            (np.full((16, 16, 16), 3.0), np.zeros(3)),
            (2.0 * x - 3.0 * y + 0.5 * z, np.array([2.0, -3.0, 0.5]))):
        flat, bases = blocks_of(dense)
        at = np.float32([0.3, 0.7, 0.9])
        along = np.float32([1.0, 2.0, -1.0])
        f, f1, f2 = jet_of(flat, bases, 5, 7, 6, at, along)
        place = np.array([6.0, 8.0, 7.0]) + at  # the second tap is where the fraction begins
        expected = dense[0, 0, 0] + gradient @ place
        assert f == pytest.approx(expected, abs=1e-4)
        assert f1 == pytest.approx(gradient @ along, abs=1e-4)
        assert f2 == pytest.approx(0, abs=1e-3)


def test_the_four_weights_sum_to_one_and_join():
    for at in np.linspace(0, 1, 11):
        np.testing.assert_allclose(weights(at, 1.0).sum(axis=1), [1, 0, 0], atol=1e-12)
    end, start = weights(1.0, 1.0)[0], weights(0.0, 1.0)[0]
    np.testing.assert_allclose(end[1:], start[:3], atol=1e-12)
    assert end[0] == pytest.approx(0) and start[3] == pytest.approx(0)
