# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parts of a map on the disk."""
from pathlib import Path

import numpy as np
import pytest

from gr2t_ros.core.colour import Colouring
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import Gr2tError
from gr2t_ros.io.formats import read
from gr2t_ros.io.parts import emptied, new_directory, Parts

COLOURING = Colouring('likelihood', 1.0, 'turbo')


def triangle() -> ViewMesh:
    """Return the smallest mesh."""
    return ViewMesh(
        np.eye(3), *(np.ones(3, np.float32) for _ in range(3)), np.array([[0, 1, 2]], np.int32),
        np.array([[0, 1]], np.int32), np.ones(1, np.float32))


def test_each_keyframe_is_a_whole_file(tmp_path: Path) -> None:
    parts = Parts(lambda: new_directory(tmp_path / 'snapshots'))
    assert str(parts) == '' and not list(tmp_path.iterdir())
    for number in (7, 12):
        parts(number, triangle(), COLOURING)
    files = sorted(parts.directory.iterdir())
    assert [path.name for path in files] == ['view_000007.ply', 'view_000012.ply']
    assert [set(read(path).attributes['view']) for path in files] == [{7}, {12}]
    assert str(parts) == (
        f'2 keyframes that left memory are in {parts.directory}: 6 vertices, 2 edges, 2 faces')


def test_two_maps_never_share_a_folder(tmp_path: Path) -> None:
    assert len({new_directory(tmp_path) for _ in range(5)}) == 5


def test_a_former_map_s_parts_leave_and_nothing_else_does(tmp_path: Path) -> None:
    Parts(lambda: tmp_path)(3, triangle(), COLOURING)
    (tmp_path / 'notes.txt').write_text('mine')
    assert [path.name for path in emptied(tmp_path).iterdir()] == ['notes.txt']


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    for make in (new_directory, emptied):
        parts = Parts(lambda make=make: make(tmp_path / 'file' / 'inside'))
        with pytest.raises(Gr2tError, match=r'cannot make the folder .*file'):
            parts(0, triangle(), COLOURING)
        assert parts.directory is None and not parts.keyframes
