# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The package's exceptions: each carries one sentence that names the thing and the way out."""


class Gr2tError(Exception):
    """Base of all errors that this package raises on purpose."""


class InputError(Gr2tError):
    """A call, parameter, file or recording that cannot be used (exit code 2)."""


class FrameError(Gr2tError):
    """
    One frame that cannot be used; the others still can.

    :param reason: a short snake_case key under which such frames are counted
    :param sentence: what is wrong with it and what to do
    """

    def __init__(self, reason: str, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason
