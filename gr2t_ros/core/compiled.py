# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How the innermost kernels are compiled, where they are kept, and shared out to threads."""
from __future__ import annotations

import atexit
from collections.abc import Callable
from concurrent.futures import Executor
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any, cast, TypeVar

from numba import config, njit

Kernel = TypeVar('Kernel', bound=Callable[..., Any])

_CACHE = 'NUMBA_CACHE_DIR'


def cache_notice() -> str:
    """Return where compiled kernels are kept, as a sentence; '' where it is as usual."""
    return _NOTICE


def _find_cache() -> str:
    """
    See to it that compiled kernels can be kept, before the first is declared.

    numba keeps them beside the sources or, where these are read-only, in the user's cache folder.
    Where that cannot be written either it would not even declare a kernel.
    """
    try:
        folder = Path(cast(Any, njit(cache=True)(_find_cache))._cache.cache_path)
    except RuntimeError:
        # new and private: what is in there is run
        private = tempfile.mkdtemp(prefix='gr2t_kernels_')
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        os.environ[_CACHE] = private
        cast(Any, config).reload_config()
        return (
            'no folder can be written to keep compiled kernels in: they are compiled at each '
            f'start, about a minute; set {_CACHE} to one that can')
    if os.environ.get(_CACHE) or folder.parent == Path(__file__).parent:
        return ''
    return (
        f'{Path(__file__).parent.parent} is read-only: compiled kernels are kept in '
        f'{folder.parent}')


_NOTICE = _find_cache()


def uncounted(**options: Any) -> Callable[[Kernel], Kernel]:
    """
    Compile a kernel without numba's counting of references to arrays.

    Each array that is taken out of a tuple or sliced is counted, with atomic operations that cost
    more than a spline's evaluation and that threads wait for each other with. Without it a kernel
    cannot make arrays: what it writes comes as arguments.

    :param options: of njit
    """
    uncounting: dict[str, Any] = {'_nrt': False}
    return cast(
        'Callable[[Kernel], Kernel]', njit(cache=True, nogil=True, **uncounting, **options))


def run_all(
    pool: Executor | None, task: Callable[..., Any], arguments: list[tuple[Any, ...]]
) -> list[Any]:
    """
    Run a kernel for all tuples of arguments.

    :param pool: where to do it; None: in this thread
    :return: the results in the arguments' order
    """
    if pool is None:
        return [task(*one) for one in arguments]
    return [done.result() for done in [pool.submit(task, *one) for one in arguments]]
