# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels are kept somewhere, also where the package and the home are read-only."""
from collections.abc import Iterator
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
from gr2t_ros.core.compiled import cache_notice
from gr2t_ros.core.blocks import key_of
key_of(1, 2, 3)
print(cache_notice())
"""


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[Path]:
    """Return a folder with the package that nobody may write to, root included."""
    folder = tmp_path / 'installed'
    folder.mkdir()
    mounted = os.geteuid() == 0
    if mounted:
        made = subprocess.run(
            ['mount', '-t', 'tmpfs', 'tmpfs', str(folder)], check=False, capture_output=True)
        if made.returncode:
            pytest.skip('root may not mount here')
    shutil.copytree(
        ROOT / 'gr2t_ros', folder / 'gr2t_ros', ignore=shutil.ignore_patterns('__pycache__'))
    if mounted:
        subprocess.run(['mount', '-o', 'remount,ro', str(folder)], check=True)
    else:
        _chmod(folder, 0o500)
    yield folder
    if mounted:
        subprocess.run(['umount', str(folder)], check=True)
    else:
        _chmod(folder, 0o700)


def _chmod(folder: Path, mode: int) -> None:
    for path in (folder, *folder.rglob('*')):
        if path.is_dir():
            path.chmod(mode)


def run(package: Path, home: Path, **environment: str) -> str:
    """Compile a kernel in a process of its own; return what is said of the cache."""
    kept = {name: value for name, value in os.environ.items()
            if name not in ('NUMBA_CACHE_DIR', 'XDG_CACHE_HOME')}
    return subprocess.run(
        [sys.executable, '-c', SCRIPT], check=True, text=True, stdout=subprocess.PIPE, cwd=home,
        env={**kept, 'PYTHONPATH': str(package), 'HOME': str(home), **environment}).stdout.strip()


def compiled(folder: Path) -> list[Path]:
    return list(folder.rglob('*.nbc'))


def test_a_read_only_install_uses_the_home(installed: Path, tmp_path: Path) -> None:
    home = tmp_path / 'home'
    home.mkdir()
    said = run(installed, home)
    assert said == (
        f'{installed}/gr2t_ros is read-only: compiled kernels are kept in {home}/.cache/numba')
    assert compiled(home)


def test_where_the_home_is_read_only_too(installed: Path, tmp_path: Path) -> None:
    """They go to a folder that nobody else can write to, and that is gone afterwards."""
    temporary = tmp_path / 'temporary'
    temporary.mkdir()
    said = run(installed, installed, TMPDIR=str(temporary))
    assert 'compiled at each start' in said and 'NUMBA_CACHE_DIR' in said
    assert list(temporary.iterdir()) == []


def test_a_folder_that_was_chosen(installed: Path, tmp_path: Path) -> None:
    chosen = tmp_path / 'chosen'
    assert run(installed, installed, NUMBA_CACHE_DIR=str(chosen)) == ''
    assert compiled(chosen)


def test_nothing_is_said_where_the_package_can_be_written(tmp_path: Path) -> None:
    package = tmp_path / 'package'
    shutil.copytree(
        ROOT / 'gr2t_ros', package / 'gr2t_ros', ignore=shutil.ignore_patterns('__pycache__'))
    assert run(package, tmp_path) == ''
    assert compiled(package)
