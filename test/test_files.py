# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whatever happens while a file is written, an older one stays whole, and it is said why."""
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import get_context
import os
from pathlib import Path
import resource
import signal
import subprocess
import time
from typing import Any

import pytest

from gr2t_ros.errors import Gr2tError, InputError
from gr2t_ros.io.files import Folder, whole_file

PROCESSES = get_context('fork')
MEGABYTE = b'x' * (1 << 20)


def write(path: Path, content: bytes = b'new') -> None:
    with whole_file(path) as stream:
        stream.write(content)


def listed(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Return a mounted disk of a megabyte."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    try:
        subprocess.run(
            ['mount', '-t', 'tmpfs', '-o', 'size=1m', 'tmpfs', str(disk)], check=True,
            capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip('only root may mount')
    yield disk
    subprocess.run(['umount', str(disk)], check=False, capture_output=True)


def test_an_older_file_is_replaced_when_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / 'made' / 'file'
    write(path, b'old')
    with whole_file(path) as stream:
        stream.write(b'new')
        stream.flush()
        assert path.read_bytes() == b'old'
    assert path.read_bytes() == b'new' and listed(path.parent) == ['file']
    with suppress(KeyError), whole_file(path) as stream:
        stream.write(b'half')
        raise KeyError
    assert path.read_bytes() == b'new' and listed(path.parent) == ['file']


def test_a_full_disk(small_disk: Path) -> None:
    path = small_disk / 'file'
    write(path, b'old')
    with pytest.raises(Gr2tError, match=r'cannot write .*file: No space left'):
        write(path, 2 * MEGABYTE)
    assert path.read_bytes() == b'old' and listed(small_disk) == ['file']


def test_a_limit_of_size(tmp_path: Path) -> None:
    """As a full disk, where root cannot mount one."""
    path = tmp_path / 'file'
    write(path, b'old')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, before[1]))
    try:
        with pytest.raises(Gr2tError, match=r'cannot write .*file: File too large'):
            write(path, 2 * MEGABYTE)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == b'old' and listed(tmp_path) == ['file']


def test_a_read_only_disk(small_disk: Path) -> None:
    path = small_disk / 'file'
    write(path, b'old')
    folder = Folder(str(small_disk))
    subprocess.run(['mount', '-o', 'remount,ro', str(small_disk)], check=True)
    with pytest.raises(Gr2tError, match=r'cannot write .*file: Read-only file system'):
        write(path)
    with pytest.raises(Gr2tError, match=r'cannot write to .*disk: Read-only file system'), (
            folder.new_file('mesh', '.ply')):
        pass
    assert path.read_bytes() == b'old'


def test_a_disk_that_is_not_there_any_more(small_disk: Path, tmp_path: Path) -> None:
    """What was the disk's folder is an empty folder of another disk then."""
    folder = Folder(str(small_disk / 'snapshots'))
    with folder.new_file('mesh', '.ply') as path:
        write(path)
    subprocess.run(['umount', str(small_disk)], check=True)
    with pytest.raises(Gr2tError, match='not on the disk where it was'), (
            folder.new_file('mesh', '.ply')):
        pass
    assert listed(small_disk) == []
    small_disk.rmdir()
    with pytest.raises(Gr2tError, match='not on the disk where it was'), (
            folder.new_file('mesh', '.ply')):
        pass
    assert listed(tmp_path) == []


def test_a_folder_that_was_removed_is_made_again(tmp_path: Path) -> None:
    folder = Folder(str(tmp_path / 'snapshots'))
    for _ in range(2):
        with folder.new_file('mesh', '.ply') as path:
            write(path)
        path.unlink()
        path.parent.rmdir()


def test_names_are_given_once(tmp_path: Path) -> None:
    """Also where the second is asked for while the first is written, and of links to nowhere."""
    folder = Folder(str(tmp_path))
    (tmp_path / 'mesh_2.ply').symlink_to(tmp_path / 'nowhere')
    with folder.new_file('mesh', '.ply') as first, folder.new_file('mesh', '.ply') as second:
        assert (first.name, second.name) == ('mesh.ply', 'mesh_3.ply')
        write(first)
        with folder.new_file('mesh', '.ply') as third:
            assert third.name == 'mesh_4.ply'
    assert listed(tmp_path) == ['mesh.ply', 'mesh_2.ply']


def test_two_processes_do_not_overwrite_each_other(tmp_path: Path) -> None:
    processes = [
        PROCESSES.Process(target=_write_many, args=(tmp_path, number)) for number in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    contents = [path.read_bytes() for path in tmp_path.glob('mesh*.ply')]
    assert sorted(contents) == sorted(
        b'%d %d' % (number, n) for number in range(4) for n in range(25))
    assert len(listed(tmp_path)) == 100


def _write_many(folder: Path, number: int) -> None:
    for n in range(25):
        with Folder(str(folder)).new_file('mesh', '.ply') as path:
            write(path, b'%d %d' % (number, n))


def test_a_file_that_another_process_is_writing(tmp_path: Path) -> None:
    path = tmp_path / 'file'
    with whole_file(path) as stream:
        with pytest.raises(Gr2tError, match='another process is writing it'):
            write(path, b'other')
        stream.write(b'first')
    assert path.read_bytes() == b'first' and listed(tmp_path) == ['file']


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    others = ['.mesh.ply.part', '.x.swp', 'notes.txt']
    for name in others:
        (tmp_path / name).write_text('')
    ours, theirs = PROCESSES.Pipe()
    process = PROCESSES.Process(target=_hang, args=(tmp_path, theirs))
    process.start()
    ours.recv()
    busy = {'.killed.ply.gr2t-part', '.killed.ply.gr2t-claim'}
    with Folder(str(tmp_path)).new_file('mesh', '.ply') as path:
        write(path)
    assert busy < set(listed(tmp_path)), 'those of a living process stay'
    process.kill()
    process.join()
    assert busy < set(listed(tmp_path))
    with Folder(str(tmp_path)).new_file('mesh', '.ply') as path:
        write(path)
    assert listed(tmp_path) == sorted([*others, 'mesh.ply', 'mesh_2.ply'])


def _hang(folder: Path, ready: Any) -> None:
    with Folder(str(folder)).new_file('killed', '.ply') as path, whole_file(path) as stream:
        stream.write(MEGABYTE)
        ready.send(None)
        time.sleep(600)


def test_a_killed_process_left_a_part_of_the_same_name(tmp_path: Path) -> None:
    (tmp_path / '.file.gr2t-part').write_bytes(2 * MEGABYTE)
    write(tmp_path / 'file')
    assert (tmp_path / 'file').read_bytes() == b'new' and listed(tmp_path) == ['file']


@pytest.mark.parametrize('name', [
    '', '.', '..', '../secret', '/etc/passwd', 'sub/file', 'link', 'loop', 'zero\0', '~/file',
    'away/secret'])
def test_names_that_lead_out_of_the_folder(tmp_path: Path, name: str) -> None:
    inner = tmp_path / 'inner'
    (inner / 'sub').mkdir(parents=True)
    (tmp_path / 'secret').write_text('')
    (inner / 'link').symlink_to(tmp_path / 'secret')
    (inner / 'away').symlink_to(tmp_path)
    (inner / 'loop').symlink_to(inner / 'loop')
    with pytest.raises(InputError, match='is not the name of a file in'):
        Folder(str(inner)).inside(name)


def test_names_that_stay_in_the_folder(tmp_path: Path) -> None:
    (tmp_path / 'real').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'real')  # the folder itself may be a link
    (tmp_path / 'real' / 'newest').symlink_to('file')
    folder = Folder(str(tmp_path / 'link'))
    for name in ('file', 'newest', './file'):
        assert folder.inside(name) == tmp_path / 'real' / 'file'


def test_a_link_is_replaced_and_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / 'secret'
    secret.write_bytes(b'old')
    (tmp_path / 'file').symlink_to(secret)
    write(tmp_path / 'file')
    assert secret.read_bytes() == b'old' and not (tmp_path / 'file').is_symlink()
    (tmp_path / '.other.gr2t-part').symlink_to(secret)
    with pytest.raises(Gr2tError, match='cannot write'):
        write(tmp_path / 'other')
    assert secret.read_bytes() == b'old'


def test_the_modes_are_those_of_the_user(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write(tmp_path / 'file')
    finally:
        os.umask(before)
    assert (tmp_path / 'file').stat().st_mode & 0o777 == 0o640
