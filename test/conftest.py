# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What several test files share."""
import hashlib
import os
from pathlib import Path

import pytest

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
