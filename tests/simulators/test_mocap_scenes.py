"""The driver named in rig.toml receives the markers of a limb from each simulated server."""

from __future__ import annotations

import asyncio
import contextlib
import time
import tomllib
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import DeviceEvent, MocapFrame
from jointfit_simulators.body import SimulatedSubject, parse_motion_script
from jointfit_simulators.scene import Scene, SceneOptions
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Chunk, Decoded

pytestmark = pytest.mark.real_time


WHOLE_FRAMES = ("natnet", "qtm", "vicon", "lsl-markers")
"""Families whose frames contain all markers. VRPN sends each tracker in its own message."""


@pytest.mark.parametrize("family", WHOLE_FRAMES)
async def test_every_marker_of_the_limb_arrives_by_name(
    tmp_path: Path, family: str, request: pytest.FixtureRequest
) -> None:
    if family == "lsl-markers":
        request.getfixturevalue("lsl_network")
    knobs = Knobs(occlusion=0.0)
    subject = SimulatedSubject(knobs, parse_motion_script("stand"), motion_files={})
    scene = Scene(knobs, subject, SceneOptions(tmp_path, mocap=family), now_ns=time.monotonic_ns())
    ready = asyncio.Event()
    playing = asyncio.create_task(scene.run(lambda _: ready.set()))
    items: list[Decoded] = []
    try:
        await ready.wait()
        rig = parse_rig(tomllib.loads((tmp_path / "rig.toml").read_text(encoding="utf-8")))
        (source,) = (one for one in rig.sources if one.id == "mocap")
        assert source.driver_class is find_driver(family)
        driver = source.driver_class(source.settings)
        decoder = driver.decoder()

        def take(chunk: Chunk) -> None:
            items.extend(decoder.feed(chunk))

        running = asyncio.create_task(driver.run(take))
        async with asyncio.timeout(15):
            while sum(isinstance(item, MocapFrame) for item in items) < 20:
                assert not running.done(), running.exception()
                await asyncio.sleep(0.02)
        running.cancel()
        await asyncio.wait([running])
    finally:
        scene.stop()
        with contextlib.suppress(asyncio.CancelledError):
            await playing

    frames = [item for item in items if isinstance(item, MocapFrame)]
    texts = [i.text for i in items if isinstance(i, DeviceEvent) and i.kind in ("warning", "error")]
    assert texts == []
    wanted = {name for names in source.settings.markers.values() for name in names}
    assert wanted <= set(frames[-1].layout.markers)
    assert all(np.isfinite(frame.markers).all() for frame in frames)
    assert all(frame.ticks is not None for frame in frames)
    # The subject stands on the floor: its markers are between floor and head, z up.
    assert 0.0 < frames[-1].markers[:, 2].min() < frames[-1].markers[:, 2].max() < 2.0
