"""Raw readings as bytes of an Xbus device, and two board trials with optical ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects import device_bytes
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import xbus
from jointfit_protocols.xbus import mtdata2
from jointfit_protocols.xbus.mtdata2 import Item

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.driver import Decoder

TRIALS = ("02_undisturbed_slow_rotation_B", "07_undisturbed_fast_rotation_B")
RATE_HZ = 286
"""Nominal rate, Hz. The ticks of the device show that the trials have 2000/7 Hz."""
PERIOD_NS = 3_500_000
_KINDS = (Item.RATE_OF_TURN, Item.ACCELERATION, Item.MAGNETIC_FIELD)


@dataclass(frozen=True, slots=True)
class BoardTrial:
    """One IMU on a board that is turned by hand."""

    felt: tuple[Array, Array, Array]
    """Angular rate, rad/s, specific force, m/s^2, and magnetic field, each of shape (n, 3) as
    32-bit floats."""
    optical: Array
    """Optical orientations q_world_sensor, shape (n, 4); NaN where occluded."""
    moving: NDArray[np.bool_]


def load(data: Path, name: str) -> BoardTrial:
    """Return a trial from the folder ``broad``, rounded to the precision of the wire format."""
    h5py = import_module("h5py")  # imported by this experiment only
    with h5py.File(data / "broad" / f"{name}.hdf5") as trial:
        rate, force, field = (
            trial[f"imu_{kind}"][:].astype(np.float32).astype(np.float64)
            for kind in ("gyr", "acc", "mag")
        )
        return BoardTrial(
            (rate, force, field), trial["opt_quat"][:], trial["movement"][:].astype(bool)
        )


def messages(felt: Sequence[Array]) -> list[bytes]:
    """Return messages with counter, time, status and the given types of readings."""
    kinds = _KINDS[: len(felt)]
    return [
        xbus.encode(
            xbus.XbusMessageId.MT_DATA2,
            mtdata2.encode_items(
                [
                    (Item.PACKET_COUNTER, k & 0xFFFF),
                    (Item.SAMPLE_TIME_FINE, k * PERIOD_NS // device_bytes.TICK_NS),
                    (Item.STATUS_WORD, 2),
                    *zip(kinds, map(tuple, rows), strict=True),
                ]
            ),
        )
        for k, rows in enumerate(zip(*felt, strict=True))
    ]


def decoder(*, magnetometer: bool, settle_s: float = 0.0) -> Decoder:
    """Return a new decoder of the driver with the settings of a rig.toml."""
    driver = find_driver("xbus")
    settings = driver.Settings(
        id="S1",
        segment="thigh",
        driver="xbus",
        port="p",
        baud=921_600,
        rate_hz=RATE_HZ,
        orientation="gateway",
        magnetometer=magnetometer,
        settle_s=settle_s,
    )
    return driver(settings).decoder()


def through_driver(felt: Sequence[Array], *, magnetometer: bool, settle_s: float = 0.0) -> Array:
    """Return the orientations q_world_sensor from the driver, shape (n, 4)."""
    path = decoder(magnetometer=magnetometer, settle_s=settle_s)
    said = [
        item.q_world_sensor
        for k, data in enumerate(messages(felt))
        for item in path.feed(Chunk(k * PERIOD_NS, data))
        if isinstance(item, ImuSample)
    ]
    return np.array(said)


def output_by_sample(felt: Sequence[Array], kept: Iterable[int], *, settle_s: float) -> Array:
    """Return q_world_sensor of each sample, with magnetometer; NaN without an output.

    Only the messages of the samples `kept` arrive.
    """
    path = decoder(magnetometer=True, settle_s=settle_s)
    sent = messages(felt)
    q = np.full((len(sent), 4), np.nan)
    for k in kept:
        for item in path.feed(Chunk(k * PERIOD_NS, sent[k])):
            if isinstance(item, ImuSample):
                q[k] = item.q_world_sensor
    return q
