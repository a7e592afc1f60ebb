# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t replay`: a recording becomes a mesh, a picture and a report."""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing, contextmanager, ExitStack
from dataclasses import asdict
from pathlib import Path
import signal
import textwrap
from threading import current_thread, Event, main_thread
from time import perf_counter
from types import FrameType

from ..core.poses import seconds
from ..core.reconstruction import Reconstruction, Update
from ..core.view import View
from ..errors import FrameError, Gr2tError, InputError
from ..io import topics
from ..io.bags import Bag
from ..io.frames import FrameAssembler
from ..io.map_file import MapFile
from ..io.parts import emptied, Parts
from ..io.views import views
from ..settings import Settings
from . import options, report
from .cli import DONE, INTERRUPTED
from .info import depth_text, poses_text
from .live import Live
from .progress import Progress, say
from .results import (
    load,
    MAP_NAME,
    march_waiting,
    opened_map,
    output_folder,
    prepare_kernels,
    write_results,
)

_MAX_WAITING = 100  # images, while the recording has not come to their poses yet
_PARTS = 'parts'  # folder of what left memory
# parameters of no effect here
_LIVE = ('max_wait_for_pose', 'cameras', 'depth_transport', 'input_qos', 'use_mask',
         'reset_on_time_jump', 'queue_size',
         'publish_rate', 'publish_views', 'display_stride',
         'snapshot_directory', 'snapshot_period', 'snapshot_on_exit', 'map_period', 'map_file')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'bags', metavar='BAG', nargs='+', type=Path,
        help='.bag, .mcap or .db3 files or rosbag2 folders; several are read as one recording')
    parser.add_argument(
        '-o', '--output', metavar='DIR', type=Path,
        help='folder of mesh.ply, preview.png and report.json; default: BAG_gr2t here')
    add_topic_arguments(parser)
    parser.add_argument('--world-frame', metavar='FRAME', help='as the parameter world_frame')
    parser.add_argument(
        '--max-frames', metavar='N', type=options.count, help='stop after N frames')
    parser.add_argument(
        '--start', metavar='S', type=_seconds, default=0.0,
        help='skip the first S seconds')
    parser.add_argument(
        '--duration', metavar='S', type=_seconds, help='use S seconds')
    parser.add_argument(
        '--per-view', action='store_true', help='also write DIR/views/view_NNNN.ply, a keyframe '
        'each')
    parser.add_argument(
        '--save-map', action='store_true', help=f'also write DIR/{MAP_NAME}: all that the map '
        'needs to go on')
    parser.add_argument(
        '--resume', metavar='MAP', type=Path, help='go on with a saved map, a file or the folder '
        'of a replay, with its parameters; images up to its newest are passed over')
    parser.add_argument(
        '--live', action='store_true', help='show the map as it grows: DIR/live.html is a page '
        'with a picture that is new every few seconds, for a tenth of the time at most')
    options.add_arguments(parser)


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that name topics."""
    group = parser.add_argument_group('topics', 'guessed where they are not given')
    group.add_argument('--depth-topic', metavar='TOPIC', default='')
    group.add_argument('--camera-info-topic', metavar='TOPIC', default='')
    group.add_argument(
        '--pose-topic', metavar='TOPIC', default='',
        help='poses: PoseStamped, PoseWithCovarianceStamped, Odometry or TransformStamped')


def run(args: argparse.Namespace) -> int:
    """
    Replay.

    :return: the exit code
    :raises InputError: if the call or the recording cannot be used
    :raises Gr2tError: if a result cannot be written
    """
    with ExitStack() as stack:
        resumed = stack.enter_context(opened_map(args.resume)) if args.resume else None
        settings = _settings(args, resumed)
        bag = stack.enter_context(Bag(args.bags))
        length = (bag.end_ns - bag.begin_ns) * 1e-9
        if bag.count and args.start >= max(length, 1e-9):
            raise InputError(f'--start {args.start:g} s is after the end of {bag.name}, '
                             f'which lasts {length:g} s')
        try:
            sources = topics.choose(
                bag, depth=args.depth_topic, camera_info=args.camera_info_topic,
                pose=args.pose_topic, pose_source=settings.pose_source,
                world_frame=settings.world_frame)
        except InputError as error:
            if not bag.damage:
                raise
            raise InputError(f'{error}\n{bag.damage}') from error
        settings = settings.updated({
            'pose_source': sources.poses.source, 'use_mask': False,
            'world_frame': settings.world_frame or sources.poses.world_frame})
        directory = output_folder(args.output or _named_after(args.bags[0]))
        say(f'{bag.name}: {length:.1f} s, {bag.count} messages')
        say(f'  depth        {depth_text(bag, sources.depth)}')
        say(f'  camera_info  {sources.camera_info}')
        say(f'  poses        {poses_text(sources.poses)}')
        say(_parameters(settings))
        parts = _parts(directory, resumed)
        done = report.Run(settings, startup_seconds=prepare_kernels(settings), parts=parts)
        with closing(Reconstruction(settings, parts)) as reconstruction:
            if resumed:
                load(resumed, reconstruction)

            def write() -> None:
                title = ' '.join(path.name for path in bag.paths)
                print(write_results(
                    reconstruction, done, directory, title, per_view=args.per_view,
                    with_map=args.save_map))
            live = Live(directory, reconstruction) if args.live else None
            try:
                interrupted = _Replay(args, bag, sources, reconstruction, done, live).read()
            except Exception:
                if done.integrated:
                    say('it failed; what was done is kept')
                    write()
                raise
            write()
    return INTERRUPTED if interrupted else DONE


def _settings(args: argparse.Namespace, resumed: MapFile | None) -> Settings:
    settings = options.settings(args, resumed.settings if resumed else None)
    if args.world_frame:
        settings = settings.updated({'world_frame': args.world_frame})
    if resumed is None:
        return settings
    resumed.check(settings)
    if settings.world_frame not in ('', resumed.world_frame):
        raise InputError(
            f'cannot go on with the map {resumed.path}: it is in the world frame '
            f'{resumed.world_frame!r}, not {settings.world_frame!r}')
    return settings.updated({'world_frame': resumed.world_frame})


def _parts(directory: Path, resumed: MapFile | None) -> Parts:
    """Return where what leaves memory goes; nothing of another map is left there."""
    folder = directory / _PARTS
    ours = resumed is not None and resumed.path.resolve().parent == directory.resolve()

    def made() -> Path:
        folder.mkdir(exist_ok=True)
        return folder if ours else emptied(folder)

    if folder.is_dir():
        made()
    return Parts(made)


class _Replay:
    """One run of the command."""

    def __init__(
        self, args: argparse.Namespace, bag: Bag, sources: topics.Sources,
        reconstruction: Reconstruction, done: report.Run, live: Live | None,
    ) -> None:
        self._args = args
        self._bag = bag
        self._sources = sources
        self._reconstruction = reconstruction
        self._done = done
        self._live = live
        self._said = False
        # of the map that it goes on with
        self._newest_ns = reconstruction.stamp_ns if reconstruction.views else -1

    def read(self) -> bool:
        """
        Read the recording into the reconstruction.

        :return: whether it was interrupted
        :raises InputError: if no frame can be used
        """
        args, done = self._args, self._done
        assembler = FrameAssembler(
            done.settings, rectified=self._sources.depth.rectified, max_waiting=_MAX_WAITING)
        stream = views(self._bag, self._sources, assembler, args.start, args.duration)
        begin = perf_counter()
        try:
            with _interruptible() as interrupted, Progress(self._expected(), 'frames') as bar:
                while not interrupted.is_set() and done.integrated != args.max_frames:
                    started = perf_counter()
                    view = next(stream, None)
                    if view is None:
                        break
                    done.seconds['read'].append(perf_counter() - started)
                    self._add(view)
                    done.seconds['total'].append(perf_counter() - started)
                    bar.reach(assembler.read)
                    if self._live:
                        self._live.reach(assembler.read, self._expected())
        finally:
            done.loop_seconds = perf_counter() - begin
            done.dropped += assembler.dropped
            # those still on their way when it was stopped count as not read
            done.read = done.integrated + done.dropped.total()
            done.explanations.update({**assembler.world.explanations, **assembler.explanations})
            done.input_damage = self._bag.damage
        if interrupted.is_set():
            if not done.integrated:
                raise KeyboardInterrupt
            return True
        if not done.integrated:
            raise InputError(self._nothing())
        begin = perf_counter()
        try:
            for update in march_waiting(self._reconstruction):
                self._count(update)
        except KeyboardInterrupt:
            return True
        finally:
            done.finish_seconds = perf_counter() - begin
        return False

    def _add(self, view: View) -> None:
        done = self._done
        try:
            if view.stamp_ns <= self._newest_ns:
                raise FrameError(
                    'in_map', 'not newer than the newest image of the map that it goes on with, '
                    f'{seconds(self._newest_ns)}')
            update = self._reconstruction.add(view)
        except FrameError as error:
            if error.reason == 'memory':
                raise Gr2tError(str(error)) from error
            done.dropped[error.reason] += 1
            done.explanations.setdefault(error.reason, str(error))
            return
        self._count(update)
        done.seconds['integrate'].append(update.seconds['integrate'])
        if update.keyframe is not None:
            done.keyframes += 1
            done.seconds['march'].append(update.seconds['march'])
        if not done.integrated:
            done.first_stamp_ns = view.stamp_ns
        done.last_stamp_ns = view.stamp_ns
        done.integrated += 1

    def _count(self, update: Update) -> None:
        self._done.count(update)
        for notice in update.notices:
            say(notice)
        if update.released and not self._said:
            self._said = True
            say('memory is full (max_memory_mb): the keyframes farthest from the camera are '
                f'finished, and go to {self._done.parts.directory}, a PLY file each')

    def _expected(self) -> int:
        """Return about how many frames there will be."""
        args, bag = self._args, self._bag
        length = max((bag.end_ns - bag.begin_ns) * 1e-9, 1e-9)
        used = min(args.duration or length, length - args.start)
        count = round(bag.topics[self._sources.depth.name].count * used / length)
        return count if args.max_frames is None else min(count, args.max_frames)

    def _nothing(self) -> str:
        done, name = self._done, self._bag.name
        damage = f'. {done.input_damage}' if done.input_damage else ''
        if not done.dropped:
            return f'there is no depth image between --start and --duration in {name}{damage}'
        reason, count = done.dropped.most_common(1)[0]
        return (f'no image on {self._sources.depth.name} in {name} can be used; {count} of '
                f'{done.read}: {done.explanations[reason]}{damage}')


@contextmanager
def _interruptible() -> Iterator[Event]:
    """Let Ctrl-C set an event, so that a frame is finished first; a second one is at once."""
    interrupted = Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()
        say('stopping after this frame, to save what is done; Ctrl-C again: at once')

    if current_thread() is not main_thread():  # others cannot handle signals
        yield interrupted
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def _named_after(bag: Path) -> Path:
    name = bag.resolve().name if bag.is_dir() else bag.stem
    return Path(f'{name}_gr2t')


def _parameters(settings: Settings) -> str:
    values = [f'{name}:={value:g}' if isinstance(value, float) else f'{name}:={value}'
              for name, value in asdict(settings).items() if name not in _LIVE]
    return textwrap.fill(
        ' '.join(values), 99, initial_indent='  parameters   ', subsequent_indent=' ' * 15)


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = float('nan')
    if not 0 <= seconds < float('inf'):
        raise argparse.ArgumentTypeError(f'must be a time in seconds, not {text}')
    return seconds
