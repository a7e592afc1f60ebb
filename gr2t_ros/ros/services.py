# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node's services."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
import rclpy.task
from std_srvs.srv import SetBool, Trigger

from .worker import Worker


class Services:
    """
    ~/save_snapshot, ~/reset, ~/pause, ~/timing.

    :param node: that offers them
    :param worker: the map
    :param pause: called with what ~/pause says
    """

    def __init__(self, node: Node, worker: Worker, pause: Callable[[bool], None]) -> None:
        self._worker = worker
        self._pause = pause
        self._log = node.get_logger()
        self.unanswered = 0
        node.create_service(
            Trigger, '~/save_snapshot', self._on_save_snapshot,
            callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, '~/reset', self._on_reset)
        node.create_service(SetBool, '~/pause', self._on_pause)
        node.create_service(Trigger, '~/timing', self._on_timing)
        self._answered = node.create_guard_condition(lambda: None)

    async def _on_save_snapshot(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Answer once the file is written; other callbacks go on meanwhile."""
        answer: Any = rclpy.task.Future()

        def wake(done: Future[Any]) -> None:
            answer.set_result(done)
            self._answered.trigger()

        self.unanswered += 1
        self._worker.snapshot().add_done_callback(wake)
        done: Future[Any] = await answer
        self.unanswered -= 1
        error = done.exception()
        response.success = error is None
        if error:
            response.message = str(error)
            self._log.warning(f'no snapshot: {response.message}')
        else:
            response.message = str(done.result())
            self._log.info(f'snapshot: {response.message}')
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
