# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A Chromium without a window, steered over its DevTools protocol: a real mouse on a real page."""
from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import json
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
import pytest

SIZE = (900, 600)
LIMIT = 120.0  # s, for what takes a second on a machine at rest
_NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')


class Browser:
    """
    One page of a Chromium.

    :param errors: what the page complained of
    """

    def __init__(self, read: int, write: int) -> None:
        self.errors: list[str] = []
        self._read = read
        self._write = write
        self._buffer = b''
        self._number = 0
        target = self._call('Target.createTarget', url='about:blank')['targetId']
        self._session = ''
        self._session = self._call('Target.attachToTarget', targetId=target, flatten=True)[
            'sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self._call(f'{domain}.enable')
        # nothing that a page needs may come from elsewhere
        self._call('Network.emulateNetworkConditions', offline=True, latency=0,
                   downloadThroughput=0, uploadThroughput=0)

    def go(self, page: Path) -> None:
        """Load a page."""
        self._call('Page.navigate', url=page.resolve().as_uri())
        self.until("document.readyState === 'complete'")

    def open(self, page: Path) -> float:
        """Load a page of `gr2t view`; return the seconds until its mesh is shown."""
        began = time.monotonic()
        self.go(page)
        self.until("document.getElementById('message').hidden")
        self.settle()
        return time.monotonic() - began

    def run(self, script: str) -> Any:
        """Return the value of an expression of JavaScript, awaited."""
        answer = self._call(
            'Runtime.evaluate', expression=script, awaitPromise=True, returnByValue=True)
        assert 'exceptionDetails' not in answer, answer
        return answer['result'].get('value')

    def until(self, condition: str) -> None:
        """Wait for an expression of JavaScript to become true."""
        began = time.monotonic()
        while not self.run(condition):
            assert time.monotonic() - began < LIMIT, condition
            time.sleep(0.05)

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.run('new Promise(done => requestAnimationFrame(() => requestAnimationFrame('
                 '() => done(true))))')

    def picture(self, path: Path | None = None) -> NDArray[np.uint8]:
        """Return (h, w, 3) what is on the screen, red green blue; and keep it as a PNG."""
        self.settle()
        content = b64decode(self._call('Page.captureScreenshot', format='png')['data'])
        if path is not None:
            path.write_bytes(content)
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        return np.asarray(decoded[..., ::-1], np.uint8)

    def drag(self, begin: tuple[float, float], end: tuple[float, float],
             button: str = 'left') -> None:
        """Drag the mouse from one place to another, pixels."""
        self._mouse('mouseMoved', begin)
        self._mouse('mousePressed', begin, button=button, clickCount=1)
        for share in (0.25, 0.5, 0.75, 1.0):
            place = tuple(a + share * (b - a) for a, b in zip(begin, end, strict=True))
            self._mouse('mouseMoved', place, button=button,
                        buttons={'left': 1, 'right': 2}[button])
        self._mouse('mouseReleased', end, button=button, clickCount=1)

    def click(self, place: tuple[float, float], times: int = 1) -> None:
        """Click at a place, pixels."""
        for count in range(1, times + 1):
            self._mouse('mousePressed', place, button='left', clickCount=count)
            self._mouse('mouseReleased', place, button='left', clickCount=count)

    def touch(self, places: list[list[tuple[float, float]]]) -> None:
        """Put fingers down, move them from place to place, and take them away."""
        for kind, fingers in zip(
                ['touchStart', *['touchMove'] * (len(places) - 1), 'touchEnd'], [*places, []],
                strict=True):
            self._call('Input.dispatchTouchEvent', type=kind, touchPoints=[
                {'x': x, 'y': y, 'id': number} for number, (x, y) in enumerate(fingers)])

    def wheel(self, place: tuple[float, float], pixels: float) -> None:
        """Turn the wheel."""
        self._mouse('mouseWheel', place, deltaX=0, deltaY=pixels)

    def place(self, selector: str, share: float = 0.5) -> tuple[float, float]:
        """Return a place on an element: so far from its left to its right, at half its height."""
        x, y, width, height = self.run(
            f'(r => [r.x, r.y, r.width, r.height])(document.querySelector({selector!r})'
            '.getBoundingClientRect())')
        return x + share * width, y + height / 2

    def _mouse(self, kind: str, place: tuple[float, ...], **rest: Any) -> None:
        self._call('Input.dispatchMouseEvent', type=kind, x=place[0], y=place[1], **rest)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': parameters}
        if getattr(self, '_session', ''):
            message['sessionId'] = self._session
        os.write(self._write, json.dumps(message).encode() + b'\0')
        while True:
            answer = self._receive()
            if answer.get('id') == self._number:
                assert 'error' not in answer, (method, answer['error'])
                found: dict[str, Any] = answer['result']
                return found
            self._note(answer.get('method'), answer.get('params', {}))

    def _note(self, method: str | None, what: dict[str, Any]) -> None:
        """Keep what a page's console shows in red, and all that it wants from a network."""
        if method == 'Runtime.exceptionThrown':
            self.errors.append(str(what['exceptionDetails']))
        elif method == 'Runtime.consoleAPICalled' and what['type'] in ('error', 'warning'):
            self.errors.append(str(what['args']))
        elif method == 'Log.entryAdded' and what['entry']['level'] == 'error':
            self.errors.append(str(what['entry']))
        elif method == 'Network.requestWillBeSent':
            url = what['request']['url']
            if not url.startswith(('file:', 'data:', 'blob:')):
                self.errors.append(f'asked for {url}')

    def _receive(self) -> dict[str, Any]:
        while b'\0' not in self._buffer:
            part = os.read(self._read, 1 << 20)
            assert part, 'Chromium has ended'
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b'\0')
        found: dict[str, Any] = json.loads(message)
        return found


@contextmanager
def browser() -> Iterator[Browser]:
    """Start a Chromium whose WebGL needs no graphics card; skip where there is none."""
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    if program is None:
        pytest.skip('Chromium is not installed')
    ours, theirs = os.pipe(), os.pipe()  # from the browser, to the browser

    def give() -> None:
        """Give the browser's ends the numbers that it expects, whatever these were before."""
        read, write = (fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (theirs[0], ours[1]))
        os.dup2(read, 3)
        os.dup2(write, 4)

    with tempfile.TemporaryDirectory(prefix='chromium-', ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [program, '--headless', '--no-sandbox', '--remote-debugging-pipe', '--no-first-run',
             '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
             '--disable-background-networking', '--hide-scrollbars',
             f'--window-size={SIZE[0]},{SIZE[1]}', f'--user-data-dir={profile}'],
            preexec_fn=give, pass_fds=(3, 4), stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL)
        os.close(theirs[0])
        os.close(ours[1])
        try:
            yield Browser(ours[0], theirs[1])
        finally:
            os.close(theirs[1])
            os.close(ours[0])
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
