# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files that a reader finds whole or not at all."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
from typing import BinaryIO
import uuid

from ..errors import Gr2tError


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """
    Write a file beside its final name; it gets that name once it is complete and on the disk.

    :param path: the final name; missing folders are made, an older file is replaced
    :raises Gr2tError: if the folder or the disk does not let it; an older file is left as it was
    """
    part = path.with_name(f'.{path.name}.{uuid.uuid4().hex[:8]}.part')
    try:
        if path.is_dir():
            raise Gr2tError(f'cannot write {path}: there is a folder of that name')
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open('xb') as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise Gr2tError(f'cannot write {path}: {error.strerror or error}') from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
