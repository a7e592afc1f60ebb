# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Progress on stderr: a bar on a terminal, a line now and then in a log."""
from __future__ import annotations

import sys
from time import monotonic
from types import TracebackType

from tqdm import tqdm

_LOG_PERIOD = 10.0  # seconds


def say(text: str) -> None:
    """Write a line that does not spoil a bar."""
    tqdm.write(text, file=sys.stderr)


class Progress:
    """
    Progress of a job; a context manager.

    done: steps so far.

    :param total: steps; an estimate will do
    :param unit: what is counted
    """

    def __init__(self, total: int, unit: str) -> None:
        self._total = total
        self._unit = unit
        self.done = 0
        self._begin = self._said = monotonic()
        self._bar = tqdm(
            total=total, unit=f' {unit}', file=sys.stderr, dynamic_ncols=True,
            disable=not sys.stderr.isatty())

    def reach(self, done: int) -> None:
        """Say that so many steps are done."""
        self._bar.update(done - self.done)
        self.done = done
        now = monotonic()
        if self._bar.disable and now - self._said > _LOG_PERIOD:
            self._said = now
            seconds = now - self._begin
            say(f'{done} of {self._total} {self._unit}, {seconds:.0f} s, {done / seconds:.1f}/s')

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.close()
