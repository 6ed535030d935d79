"""Recordings of the simulated leg, which the daemon makes in real time.

Invariant: the processes are the same as for a user: ``jointfit-sim``, jointfitd with
``[recording]``, and a broker. The leg has four IMUs at 100 Hz and cameras at 100 frames per second.
"""

from __future__ import annotations

import asyncio
import shutil
from typing import TYPE_CHECKING, Literal

from tests.broker_fixture import chosen_broker
from tests.system.station import Station, running, stopped
from tests.system.test_calibrated_run import calibrate

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

Kind = Literal["cameras", "imus", "chain"]
KINDS: dict[Kind, tuple[str, tuple[str, ...]]] = {
    "cameras": ("IMUs and cameras, calibrated in the recording", ()),
    "imus": ("IMUs, calibrated before", ("--no-mocap",)),
    "chain": ("IMUs and cameras with chain model", ("--chain-model",)),
}
"""Text of each recording, and options of ``jointfit-sim``. The recording `imus` uses the
calibration of the recording `cameras`."""
MOTIONS, MOTION_S = ("walk", "squat", "sit_to_stand"), 10.0


def record_leg(folder: Path, seconds: float) -> dict[Kind, Path]:
    """Make recordings of `seconds` after the calibration; return their folders below `folder`."""
    broker = chosen_broker()(folder)
    broker.start()
    try:
        return {kind: asyncio.run(_record(folder, kind, seconds, broker)) for kind in KINDS}
    finally:
        broker.stop()


async def _record(folder: Path, kind: Kind, seconds: float, broker: Broker) -> Path:
    own = folder / kind
    own.mkdir()
    if kind == "imus":
        shutil.copytree(folder / "cameras/state/calibrations", own / "state/calibrations")

    station = Station(own, broker.port, KINDS[kind][1], more_toml="[recording]\n")
    async with running(station) as (simulator, daemon, listener):
        if kind != "imus":
            await calibrate(simulator, listener)
            await listener.until(lambda: listener.latest["calibration"]["version"])
        for number in range(round(seconds / MOTION_S)):
            await simulator.send_command(f"play {MOTIONS[number % len(MOTIONS)]}")
            await asyncio.sleep(MOTION_S)
        code, _ = await stopped(daemon)
        assert code == 0, station.log
    return own / "state" / "recordings"
