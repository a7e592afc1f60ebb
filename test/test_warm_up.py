# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is compiled at the start need not be waited for later."""
from gr2t_ros.core import seen_space, sight
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings


def test_warming_up_leaves_nothing_to_compile() -> None:
    assert warm_up(Settings()) >= 0
    assert warm_up(Settings(start='observed', keyframe_rotation=1.0)) < 5
    for kernel in (seen_space._vote, sight.nearest, sight.look):
        assert kernel.signatures, kernel
