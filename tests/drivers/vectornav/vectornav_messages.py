"""Messages of VectorNav devices for tests of the driver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import Chunk
from jointfit_drivers.vectornav import VectorNavImu, VectorNavSettings
from jointfit_protocols.vectornav import Field, encode_binary

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000
NATIVE = (0.5, -0.5, 0.1, 0.7)


def settings(folder: Path | None = None, **more: Any) -> VectorNavSettings:
    port = "p" if folder is None else str(folder / "imu")
    table: dict[str, Any] = {"silence_s": 0.5} | more
    return VectorNavSettings(id="S1", segment="thigh", driver="vectornav", port=port, **table)


def output(t_ns: int | None, q: tuple[float, ...] = NATIVE) -> bytes:
    """Return a binary output with an orientation; without a time field if `t_ns` is None."""
    w, x, y, z = q
    time = {} if t_ns is None else {int(Field.TIME_STARTUP): (t_ns,)}
    return encode_binary({**time, int(Field.QUATERNION): (x, y, z, w)})


def decoded(messages: list[bytes], **more: Any) -> list[Decoded]:
    """Return the output of a decoder for messages that arrive at intervals of one period."""
    decoder = VectorNavImu(settings(**more)).decoder()
    found = [
        event
        for k, data in enumerate(messages)
        for event in decoder.feed(Chunk(k * PERIOD_NS, data))
    ]
    return found + decoder.flush()
