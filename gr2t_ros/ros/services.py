# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node's services."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
import rclpy.task
from std_srvs.srv import SetBool, Trigger

from .worker import Worker


class Services:
    """
    ~/save_snapshot, ~/save_map, ~/load_map, ~/reset, ~/pause, ~/timing.

    :param node: that offers them
    :param worker: the map
    :param pause: called with what ~/pause says
    """

    def __init__(self, node: Node, worker: Worker, pause: Callable[[bool], None]) -> None:
        self._worker = worker
        self._pause = pause
        self._log = node.get_logger()
        self.unanswered = 0
        saver = worker.saver
        for name, begin in (
                ('save_snapshot', saver.snapshot), ('save_map', saver.save_map),
                ('load_map', saver.load_map)):
            node.create_service(
                Trigger, f'~/{name}', partial(self._on_slow, name, begin),
                callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, '~/reset', self._on_reset)
        node.create_service(SetBool, '~/pause', self._on_pause)
        node.create_service(Trigger, '~/timing', self._on_timing)
        self._answered = node.create_guard_condition(lambda: None)

    async def _on_slow(
        self, name: str, begin: Callable[[], Future[Any]], _: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        """Answer once the file is written or read; other callbacks go on meanwhile."""
        answer: Any = rclpy.task.Future()

        def wake(done: Future[Any]) -> None:
            answer.set_result(done)
            self._answered.trigger()

        self.unanswered += 1
        begin().add_done_callback(wake)
        done: Future[Any] = await answer
        self.unanswered -= 1
        error = done.exception()
        response.success = error is None
        response.message = str(error or done.result())
        if error:
            self._log.warning(f'{name} failed: {response.message}')
        else:
            self._log.info(f'{name}: {response.message}')
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._worker.reset()
        response.success = True
        response.message = 'the map is empty'
        self._log.info(f'reset: {response.message}')
        return response

    def _on_timing(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = self._worker.summary()
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pause(request.data)
        response.success = True
        response.message = 'paused: images are ignored' if request.data else 'running'
        self._log.info(f'pause: {response.message}')
        return response
