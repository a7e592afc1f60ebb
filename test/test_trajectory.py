# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Poses survive a file of the TUM format."""
from pathlib import Path

import numpy as np
import pytest

from gr2t_ros.errors import InputError
from gr2t_ros.io import trajectory
from gr2t_ros.tools.orbit import orbit


def test_what_is_written_is_read_back_in_order(tmp_path: Path) -> None:
    poses = orbit((1.0, 2.0, 3.0), 0.4, 5)
    stamps = [500_000_000, 3 * 10 ** 9 + 1000, 2 * 10 ** 9, 4 * 10 ** 9, 4 * 10 ** 9]
    trajectory.write(tmp_path / 'way.txt', zip(stamps, poses, strict=True))
    found_stamps, found = trajectory.read(tmp_path / 'way.txt')
    assert found_stamps == sorted(stamps)
    np.testing.assert_allclose(found, [poses[i] for i in (0, 2, 1, 3, 4)], atol=1e-8)


def test_a_line_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    for text, sentence in (
            ('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 2', 'line 2: not "timestamp'),
            ('2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1', 'line 2: timestamps must'), ('#', 'no poses')):
        (tmp_path / 'way.txt').write_text(text)
        with pytest.raises(InputError, match=sentence):
            trajectory.read(tmp_path / 'way.txt')
