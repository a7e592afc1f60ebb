# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How far a mesh is from the true surface; the measures are defined in docs/simulation.md."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
import trimesh
from trimesh.sample import sample_surface

from ..errors import InputError
from .distance import Surface
from .simulate import load_mesh

THRESHOLDS = (0.001, 0.002)  # m
_SAMPLES = 200_000


@dataclass(frozen=True)
class AtThreshold:
    """
    Shares within a distance.

    :param threshold_m: the distance, metres
    :param precision: of the mesh's vertices that lie within it of the reference
    :param completeness: of the reference's surface that lies within it of the mesh
    :param f_score: the harmonic mean of the two
    """

    threshold_m: float
    precision: float
    completeness: float
    f_score: float


@dataclass(frozen=True)
class MostLikely:
    """
    A point of the confidence curve.

    :param share: of the vertices, those with the largest likelihoods
    :param mean_m: their mean distance to the reference's surface, metres
    """

    share: float
    mean_m: float


@dataclass(frozen=True)
class Evaluation:
    """
    A mesh against a reference.

    :param mean_m: distances of the mesh's vertices to the reference's surface, metres; likewise
        median_m, p95_m (95th percentile) and max_m
    :param confidence_curve: by tenths; empty where the mesh has no likelihoods
    """

    vertices: int
    faces: int
    mean_m: float
    median_m: float
    p95_m: float
    max_m: float
    thresholds: tuple[AtThreshold, ...]
    confidence_curve: tuple[MostLikely, ...]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'mesh', metavar='MESH', type=Path, help='a mesh that trimesh reads (PLY, OBJ, STL ...)')
    parser.add_argument(
        'reference', metavar='REFERENCE', type=Path,
        help='the true surface, likewise, in the same frame and unit; or the word tabletop')
    parser.add_argument(
        '--threshold', metavar='M', type=float, action='append',
        help='a distance for precision, completeness (of all of the reference, also of what no '
        'camera saw) and F-score; may be repeated (0.001 and 0.002)')
    parser.add_argument('--json', action='store_true', help='print JSON instead of a table')


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    mesh, reference = load_mesh(args.mesh), load_mesh(args.reference)
    thresholds = tuple(sorted(set(args.threshold or THRESHOLDS)))
    result = evaluate(
        mesh, reference, mesh.vertex_attributes.get('likelihood'), thresholds)
    print(json.dumps(asdict(result), indent=2) if args.json else table(result))
    return 0


def evaluate(
    mesh: trimesh.Trimesh,
    reference: trimesh.Trimesh,
    likelihood: ArrayLike | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
) -> Evaluation:
    """
    Measure a mesh against the true surface.

    :param mesh: same frame and unit (metres) as the reference
    :param likelihood: (n,) of the mesh's vertices
    :param thresholds: metres
    :raises InputError: if a threshold is not positive, or the meshes lie apart
    """
    for threshold in thresholds:
        if not 0.0 < threshold < np.inf:
            raise InputError(f'a threshold must be above 0 m, not {threshold:g}')
    distance = Surface(reference.triangles).distances(mesh.vertices)
    size = float(np.linalg.norm(reference.extents))
    if np.median(distance) > size:
        raise InputError(
            f'the mesh lies {np.median(distance):.3g} m from the reference, which is {size:.3g} m '
            'wide: bring both to the same frame and to metres')
    # a fixed seed: the same meshes give the same figures
    samples, _ = sample_surface(reference, _SAMPLES, seed=0)
    missed = Surface(mesh.triangles).distances(samples)
    return Evaluation(
        vertices=len(mesh.vertices), faces=len(mesh.faces),
        mean_m=float(distance.mean()), median_m=float(np.median(distance)),
        p95_m=float(np.percentile(distance, 95)), max_m=float(distance.max()),
        thresholds=tuple(_shares(distance, missed, threshold) for threshold in thresholds),
        confidence_curve=() if likelihood is None else confidence_curve(distance, likelihood))


def _shares(
    distance: NDArray[np.float64], missed: NDArray[np.float64], threshold: float
) -> AtThreshold:
    precision = float(np.mean(distance <= threshold))
    completeness = float(np.mean(missed <= threshold))
    both = precision + completeness
    return AtThreshold(
        threshold, precision, completeness, 2 * precision * completeness / both if both else 0.0)


def confidence_curve(distance: ArrayLike, likelihood: ArrayLike) -> tuple[MostLikely, ...]:
    """
    Return the mean distance of the most likely tenth, two tenths ... of the vertices.

    :param distance: (n,) metres
    :param likelihood: (n,) in any unit; NaN counts as the least
    """
    score = np.nan_to_num(np.asarray(likelihood, np.float64), nan=-np.inf)
    ordered = np.asarray(distance, np.float64)[np.argsort(-score, kind='stable')]
    counts = [max(round(len(ordered) * tenth / 10), 1) for tenth in range(1, 11)]
    means = np.cumsum(ordered)[np.array(counts) - 1] / counts
    return tuple(MostLikely(tenth / 10, float(mean)) for tenth, mean in enumerate(means, 1))


def nause(distance: ArrayLike, score: ArrayLike) -> float:
    """
    Return how well a score orders vertices: 0 as their distances do, 1 as a random order does.

    The normalised area under the sparsification error: the mean distance of the best 1 %, 2 % ...
    of the vertices, averaged, between what the true order and what a random order gives.

    :param distance: (n,) metres
    :param score: (n,) more is better; NaN counts as the least
    """
    error = np.asarray(distance, np.float64)
    ranks = np.nan_to_num(np.asarray(score, np.float64), nan=-np.inf, posinf=np.inf)
    counts = np.maximum(np.arange(1, 101) * len(error) // 100, 1)

    def area(order: NDArray[np.int64]) -> float:
        return float(np.mean(np.cumsum(error[order])[counts - 1] / counts))

    oracle = area(np.argsort(error, kind='stable'))
    random = float(error.mean())
    if random == oracle:
        return 0.0
    return (area(np.argsort(-ranks, kind='stable')) - oracle) / (random - oracle)


def table(result: Evaluation) -> str:
    """Return the figures as a table for people."""
    lines = [
        f'{result.vertices} vertices, {result.faces} faces',
        'distance to the reference (mm)',
        f'  mean {1e3 * result.mean_m:.3f}   median {1e3 * result.median_m:.3f}   '
        f'95 % {1e3 * result.p95_m:.3f}   max {1e3 * result.max_m:.3f}',
        'within (mm)   precision %   completeness %   F-score %']
    for row in result.thresholds:
        lines.append(
            f'{1e3 * row.threshold_m:11g}   {100 * row.precision:11.2f}   '
            f'{100 * row.completeness:14.2f}   {100 * row.f_score:9.2f}')
    if result.confidence_curve:
        lines += [
            'most likely vertices, their mean distance (mm)',
            '  ' + '  '.join(f'{100 * point.share:5.0f} %' for point in result.confidence_curve),
            '  ' + '  '.join(f'{1e3 * point.mean_m:7.3f}' for point in result.confidence_curve)]
    return '\n'.join(lines)
