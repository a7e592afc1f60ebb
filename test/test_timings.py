# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The timing table says what was measured."""
import pytest

from gr2t_ros.ros.timings import Timings


def test_the_table():
    timings = Timings()
    for i in range(1, 101):
        timings.add('march', i / 1000)
    timings.add('publish', 2.0)
    assert [line.split() for line in timings.table().splitlines()] == [
        ['ms', 'count', 'mean', 'p50', 'p95', 'max'],
        ['march', '100', '50.5', '50.5', '95.0', '100.0'],
        ['publish', '1', '2000.0', '2000.0', '2000.0', '2000.0']]
    assert timings.percentile('march', 50, newest=1) == 0.1
    assert timings.percentile('mesh', 50) is None
    assert timings.total('march') == pytest.approx(5.05) and timings.total('mesh') == 0


def test_what_fails_is_not_measured():
    timings = Timings()
    with pytest.raises(ValueError, match='no'), timings.measure('publish', cpu=True):
        raise ValueError('no')
    assert timings.total('publish') == 0
    with timings.measure('publish', cpu=True):
        pass
    assert timings.total('publish') > 0
