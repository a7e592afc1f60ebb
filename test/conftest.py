# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What several test files share."""
from __future__ import annotations

from collections.abc import Callable, Iterator
import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from ros_for_tests import Isolation, Observer
    from worker_for_tests import Rig

PROJECT = Path(__file__).resolve().parents[1]
DATA = PROJECT.parent / 'shared' / 'data'

# numba does not notice when a kernel that another one calls has changed: a cache for each state of
# the sources. Set before anything imports numba; child processes inherit it.
_state = hashlib.sha256(b''.join(
    path.read_bytes() for path in sorted((PROJECT / 'gr2t_ros').rglob('*.py'))
    if b'njit' in path.read_bytes())).hexdigest()[:12]
os.environ.setdefault('NUMBA_CACHE_DIR', str(PROJECT / '.cache' / 'numba' / _state))


@pytest.fixture(scope='session')
def data() -> Path:
    """Return the folder of real bags and meshes, or skip: it is not part of the project."""
    if not DATA.is_dir():
        pytest.skip(f'no test data at {DATA}')
    return DATA


@pytest.fixture
def isolation() -> Isolation:
    """Return a ROS domain that no other test uses."""
    from ros_for_tests import Isolation
    return Isolation()


@pytest.fixture
def observer(isolation: Isolation) -> Iterator[Observer]:
    """Return a node of this process in the test's domain."""
    from ros_for_tests import Observer
    observer = Observer(isolation)
    yield observer
    observer.close()


@pytest.fixture(scope='session')
def plane_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a plane."""
    from worker_for_tests import record_plane
    return record_plane(tmp_path_factory.mktemp('bags') / 'plane')


@pytest.fixture
def make_worker(plane_recording: Path, tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Return a function that makes a running worker with some parameters."""
    from worker_for_tests import workers
    with workers(plane_recording, tmp_path / 'snapshots') as make:
        yield make
