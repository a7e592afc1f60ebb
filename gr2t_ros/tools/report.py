# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a run did: counts, timings and results, as report.json and as a table."""
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
import json
from pathlib import Path
import resource
import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..core.next_views import NextView
from ..core.reconstruction import Update
from ..io.files import whole_file
from ..io.parts import Parts
from ..settings import Settings

_NEXT = 3  # views that the table names
STAGES = ('read', 'integrate', 'march', 'mesh', 'total')


@dataclass
class Run:
    """
    What is counted and timed while a recording is replayed.

    :param parts: of the map that left memory
    :param seconds: of each of STAGES, once per frame in which the stage ran
    :param loop_seconds: wall time from the first read to the last frame done
    :param first_stamp_ns: of the images that were integrated; likewise last_stamp_ns
    :param next_views: where to scan next, the best first
    """

    settings: Settings
    parts: Parts
    read: int = 0
    integrated: int = 0
    keyframes: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    explanations: dict[str, str] = field(default_factory=dict)
    marched: int = 0
    remarched: int = 0
    converged: int = 0
    seconds: dict[str, list[float]] = field(
        default_factory=lambda: {stage: [] for stage in STAGES})
    loop_seconds: float = 0.0
    startup_seconds: float = 0.0
    finish_seconds: float = 0.0
    first_stamp_ns: int = 0
    last_stamp_ns: int = 0
    input_damage: str = ''
    next_views: tuple[NextView, ...] = ()

    def count(self, update: Update) -> None:
        """Add the rays that a step marched."""
        self.marched += update.marched
        self.remarched += update.remarched
        self.converged += update.converged


def report(run: Run, counts: Mapping[str, int], likelihood: ArrayLike) -> dict[str, Any]:
    """
    Return the content of report.json.

    :param counts: vertices and faces of the mesh that was written; parts that left memory
        before have their own
    :param likelihood: (n,) of its vertices
    """
    recorded = (run.last_stamp_ns - run.first_stamp_ns) * 1e-9
    likelihood = np.asarray(likelihood, np.float64)
    some = likelihood.size > 0
    return {
        'frames': {
            'read': run.read, 'integrated': run.integrated, 'keyframes': run.keyframes,
            'dropped': dict(sorted(run.dropped.items()))},
        'rays': {
            'marched': run.marched, 'remarched': run.remarched, 'converged': run.converged},
        'timing_ms': {stage: _milliseconds(run.seconds[stage]) for stage in STAGES},
        'frames_per_second': run.integrated / run.loop_seconds if run.loop_seconds else 0.0,
        'realtime_factor': recorded / run.loop_seconds if run.loop_seconds else 0.0,
        'peak_memory_mb': peak_memory_mb(),
        'mesh': dict(counts),
        'parts': {name: getattr(run.parts, name)
                  for name in ('keyframes', 'vertices', 'edges', 'faces')},
        'likelihood': {
            'max': float(likelihood.max()) if some else 0.0,
            'p50': float(np.percentile(likelihood, 50)) if some else 0.0,
            'p98': float(np.percentile(likelihood, 98)) if some else 0.0},
        'next_views': [_next_view(view) for view in run.next_views],
        'startup_s': run.startup_seconds,
        'finish_s': run.finish_seconds,
        'input_damage': run.input_damage,
        'settings': asdict(run.settings),
    }


def write(path: Path, content: Mapping[str, Any]) -> None:
    """
    Write a report.

    :raises Gr2tError: if the file cannot be written
    """
    with whole_file(path) as stream:
        stream.write(json.dumps(content, indent=2).encode() + b'\n')


def table(content: Mapping[str, Any], run: Run, results: Mapping[str, str]) -> str:
    """
    Return a report as a few lines to read.

    :param results: path of each file written -> what it is
    """
    frames, rays, timing = content['frames'], content['rays'], content['timing_ms']
    width = max(map(len, results), default=0)
    lines = [f'{path:{width}}  {text}'.rstrip() for path, text in results.items()]
    lines += [
        f'frames   {frames["read"]} read, {frames["integrated"]} integrated, '
        f'{frames["keyframes"]} keyframes, {sum(frames["dropped"].values())} dropped']
    lines += [f'dropped  {count} {reason}: {run.explanations.get(reason, "")}'
              for reason, count in frames['dropped'].items()]
    lines += [f'note     {sentence}' for reason, sentence in run.explanations.items()
              if reason not in frames['dropped']]
    lines += [
        f'rays     {rays["marched"]} marched, {rays["remarched"]} times again; '
        f'{100 * rays["converged"] / max(rays["marched"] + rays["remarched"], 1):.1f} % converged']
    if run.loop_seconds:
        lines += [
            f'time     {run.loop_seconds:.1f} s: {content["frames_per_second"]:.2f} frames/s, '
            f'{content["realtime_factor"]:.2f} x real time; besides {run.startup_seconds:.1f} s '
            f'for the kernels and {run.finish_seconds:.1f} s to finish and write',
            'mean     ' + ', '.join(f'{stage} {timing[stage]["mean"]:.1f} ms' for stage in STAGES)]
    lines.append(f'memory   {content["peak_memory_mb"]:.0f} MB at most')
    if content['mesh'].get('vertices') == 0:
        lines.append(
            'note     the mesh is empty: no ray found a maximum of the likelihood; are the '
            'poses those of the images, and is depth_bandwidth not far below the noise?')
    lines += [_next_line(view) for view in run.next_views[:_NEXT]]
    if run.input_damage:
        lines.append(f'damage   {run.input_damage}')
    return '\n'.join(lines)


def _next_view(view: NextView) -> dict[str, Any]:
    """Return a suggested view as JSON has it: the quaternion is x y z w, the frame optical."""
    T = view.T_world_camera
    return {
        'position': _rounded(view.position), 'area_m2': round(view.area, 6),
        'viewpoint': {
            'position': _rounded(T[:3, 3]),
            'orientation': _rounded(Rotation.from_matrix(T[:3, :3]).as_quat())}}


def _next_line(view: NextView) -> str:
    def text(place: NDArray[np.float64]) -> str:
        return '(' + ', '.join(f'{value:.2f}' for value in place) + ')'
    return (f'next     about {view.area:.2g} m² missing or doubtful at {text(view.position)}: '
            f'look from {text(view.T_world_camera[:3, 3])}')


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 4) for value in values]


def peak_memory_mb() -> float:
    """Return the largest resident size of this process so far, 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == 'darwin' else peak * 1024 / 1e6


def _milliseconds(seconds: Sequence[float]) -> dict[str, float]:
    if not seconds:
        return {'mean': 0.0, 'p50': 0.0, 'p95': 0.0}
    p50, p95 = np.percentile(seconds, (50, 95))
    return {'mean': 1e3 * float(np.mean(seconds)), 'p50': 1e3 * float(p50),
            'p95': 1e3 * float(p95)}
