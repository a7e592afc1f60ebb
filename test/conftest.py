# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What several test files share."""
from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'


@pytest.fixture(scope='session')
def data() -> Path:
    """Return the folder of real bags and meshes, or skip: it is not part of the project."""
    if not DATA.is_dir():
        pytest.skip(f'no test data at {DATA}')
    return DATA
