# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How the innermost kernels are compiled, and shared out to threads."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, cast, TypeVar

from numba import njit

Kernel = TypeVar('Kernel', bound=Callable[..., Any])


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
