# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How long things take."""
from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import threading
import time

import numpy as np

_RECENT = 2000  # measurements a stage of which the percentiles are


@dataclass
class _Stage:
    count: int = 0
    total: float = 0.0
    largest: float = 0.0
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))


class Timings:
    """
    Counts, means, percentiles and maxima of named stages; any thread may add and ask.

    Stages are listed in the order in which they first came.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stages: dict[str, _Stage] = {}

    def add(self, name: str, seconds: float) -> None:
        """Add a measurement."""
        with self._lock:
            stage = self._stages.setdefault(name, _Stage())
            stage.count += 1
            stage.total += seconds
            stage.largest = max(stage.largest, seconds)
            stage.recent.append(seconds)

    @contextmanager
    def measure(self, name: str, *, cpu: bool = False) -> Iterator[None]:
        """
        Add the time that a block takes, unless it fails.

        :param cpu: also the thread's CPU time, as a stage of its own
        """
        began, cpu_began = time.perf_counter(), time.thread_time()
        yield
        self.add(name, time.perf_counter() - began)
        if cpu:
            self.add(f'{name}, CPU', time.thread_time() - cpu_began)

    def total(self, name: str) -> float:
        """Return all seconds of a stage."""
        with self._lock:
            return self._stages[name].total if name in self._stages else 0.0

    def percentile(self, name: str, percent: float, newest: int = _RECENT) -> float | None:
        """Return a percentile of a stage's newest measurements, seconds; None without any."""
        with self._lock:
            recent = list(self._stages[name].recent)[-newest:] if name in self._stages else []
        return float(np.percentile(recent, percent)) if recent else None

    def table(self) -> str:
        """Return all stages as lines, in milliseconds; percentiles are of the newest 2000."""
        with self._lock:
            stages = {
                name: (stage.count, stage.total, list(stage.recent), stage.largest)
                for name, stage in self._stages.items()}
        lines = [f'{"ms":<17} {"count":>7} {"mean":>9} {"p50":>9} {"p95":>9} {"max":>9}']
        for name, (count, total, recent, largest) in stages.items():
            numbers = (total / count, *np.percentile(recent, (50, 95)), largest)
            lines.append(f'{name:<17} {count:>7} ' + ' '.join(
                f'{1000 * number:>9.1f}' for number in numbers))
        return '\n'.join(lines)
