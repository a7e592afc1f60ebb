# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t info`: what a recording holds, and what replay would use."""
from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from ..errors import InputError
from ..io import topics
from ..io.bags import Bag
from .cli import DONE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'bags', metavar='BAG', nargs='+', type=Path,
        help='.bag, .mcap or .db3 files or rosbag2 folders; several are read as one recording')


def run(args: argparse.Namespace) -> int:
    """
    Print it.

    :return: the exit code: also 0 where replay could not use the recording
    :raises InputError: if it cannot be read
    """
    with Bag(args.bags) as bag:
        length = (bag.end_ns - bag.begin_ns) * 1e-9
        print(f'{bag.name}: {length:.1f} s, {bag.count} messages, {len(bag.topics)} topics')
        width = max((len(name) for name in bag.topics), default=0)
        for topic in bag.topics.values():
            print(f'  {topic.count:8d}  {topic.name:{width}}  {", ".join(topic.types)}')
        print('replay would use')
        _print_choice(bag)
        if bag.damage:
            print(f'damage\n  {bag.damage}')
    return DONE


def _print_choice(bag: Bag) -> None:
    try:
        depth = topics.choose_depth(bag)
    except InputError as error:
        print(f'  depth        {error}')
        return
    print(f'  depth        {depth_text(bag, depth)}')
    choices: tuple[tuple[str, Callable[[], str]], ...] = (
        ('camera_info', lambda: topics.choose_camera_info(bag, depth)),
        ('poses', lambda: poses_text(topics.choose_poses(bag, depth.frame))))
    for name, choose in choices:
        try:
            print(f'  {name:11}  {choose()}')
        except InputError as error:
            print(f'  {name:11}  {error}')


def depth_text(bag: Bag, depth: topics.DepthTopic) -> str:
    """Return a depth topic and what is assumed of it."""
    kind = 'rectified: P of camera_info' if depth.rectified else 'raw: K and D of camera_info'
    count = bag.topics[depth.name].count
    return f'{depth.name} ({count} images; {kind}; frame {depth.frame})'


def poses_text(poses: topics.PoseTopics) -> str:
    """Return where poses come from."""
    return f'{poses.topic or " ".join(poses.transforms)} ({poses.source})'
