"""Sampled stacks are assigned to the part of the program that was running."""

from __future__ import annotations

import pytest

from bench.experiments.speed.live_profile import LOOP, part_of, shares

MAIN = "_run (jointfit_daemon/__main__.py:159)", "BaseEventLoop._run_once (asyncio/base_events.py)"
FEED = *MAIN, "Core.feed (jointfit_daemon/pipeline/_core.py:200)"


@pytest.mark.parametrize(
    ("stack", "part"),
    [
        (MAIN, LOOP),
        ((*MAIN, "select (selectors.py:468)"), LOOP),
        ((*FEED, "feed (jointfit_protocols/xbus/_framing.py:60)"), "IMU samples"),
        ((*FEED, "read (jointfit_protocols/natnet/_frame_layout.py:9)"), "camera frames"),
        ((*FEED, "fit (jointfit_daemon/fusion/_cluster_pose.py:80)"), "cameras in the core"),
        ((*FEED, "fuse (jointfit_daemon/fusion/_limb_fuser.py:80)"), "fusion"),
        ((*MAIN, "pump (jointfit_drivers/ports/serial_port.py:80)"), "ports"),
        (
            (*FEED, "_segment (jointfit_daemon/outputs/payloads/_encoding.py:8)", "f (x.py)"),
            "encod",
        ),
        (FEED, "core and supervisor"),
    ],
)
def test_a_stack_counts_for_the_innermost_function_of_the_project(
    stack: tuple[str, ...], part: str
) -> None:
    assert part_of(stack).startswith(part)


def test_shares_are_weighted_by_samples() -> None:
    text = (
        f"{';'.join(MAIN)} 30\n{';'.join((*MAIN, 'f (jointfit_daemon/outputs/mqtt/_a.py:1)'))} 10\n"
    )
    assert shares(text) == {LOOP: 0.75, "queue, MQTT and socket": 0.25}
