# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t merge`: saved maps of one world become one map, and its mesh."""
from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from ..core.merge import add_map
from ..core.reconstruction import Reconstruction
from ..errors import InputError
from ..io.parts import Parts
from ..settings import Settings
from . import options, report
from .cli import DONE
from .results import (
    load,
    march_waiting,
    opened_map,
    output_folder,
    prepare_kernels,
    write_results,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'maps', metavar='MAP', nargs='+', type=Path,
        help='a map that `gr2t replay --save-map` or the node saved, or the folder of such a '
        'replay; of one alone the mesh is made')
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path, required=True,
        help='folder of map.gr2t, mesh.ply, preview.png and report.json')
    parser.add_argument(
        '--per-view', action='store_true', help='also write DIR/views/view_NNNN.ply, a keyframe '
        'each')
    options.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """
    Merge.

    :return: the exit code
    :raises InputError: if a map cannot be used, or they do not fit together
    :raises Gr2tError: if a result cannot be written
    """
    with opened_map(args.maps[0]) as first:
        settings = options.settings(args, first.settings).updated(
            {'world_frame': first.world_frame})
        directory = output_folder(args.output)
        done = report.Run(
            settings, startup_seconds=prepare_kernels(settings), parts=Parts(lambda: directory))
        with closing(Reconstruction(settings)) as reconstruction:
            load(first, reconstruction)
            for path in args.maps[1:]:
                _add(path, reconstruction, settings)
            for update in march_waiting(reconstruction):
                done.count(update)
            done.read = done.integrated = reconstruction.views
            done.keyframes = len(reconstruction.keyframes)
            title = ' + '.join(path.name for path in args.maps)
            print(write_results(
                reconstruction, done, directory, title, per_view=args.per_view, with_map=True))
    return DONE


def _add(path: Path, reconstruction: Reconstruction, settings: Settings) -> None:
    with opened_map(path) as file:
        if file.world_frame != settings.world_frame:
            raise InputError(
                f'cannot add the map {file.path}: it is in the world frame '
                f'{file.world_frame!r}, the first in {settings.world_frame!r}')
        with closing(Reconstruction(file.settings)) as other:
            load(file, other)
            try:
                add_map(reconstruction, other)
            except InputError as error:
                raise InputError(f'cannot add the map {file.path}: {error}') from error
