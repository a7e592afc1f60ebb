# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The package finds its presets wherever it was installed to."""
from __future__ import annotations

from pathlib import Path
import shutil

import pytest

from gr2t_ros import share
from gr2t_ros.errors import InputError

CHECKOUT = Path(__file__).resolve().parents[1]


def test_checkout_is_its_own_share_directory() -> None:
    assert share.share_directory() == CHECKOUT
    assert (share.share_directory() / 'config' / 'gr2t.yaml').is_file()


@pytest.mark.parametrize('site', [
    'lib/python3.12/site-packages',  # colcon, and pip in a virtual environment
    'local/lib/python3.12/dist-packages',  # Debian's and Ubuntu's Python
])
def test_installed_package_finds_the_share_folder_of_its_prefix(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, site: str) -> None:
    module = tmp_path / site / 'gr2t_ros' / 'share.py'
    folder = tmp_path / 'share' / 'gr2t_ros'
    (folder / 'config').mkdir(parents=True)
    shutil.copy(CHECKOUT / 'package.xml', folder)
    monkeypatch.setattr(share, '__file__', str(module))
    assert share.share_directory() == folder


def test_copy_without_its_share_folder_says_so(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(share, '__file__', str(tmp_path / 'gr2t_ros' / 'share.py'))
    with pytest.raises(InputError, match='install the package with colcon or pip'):
        share.share_directory()
