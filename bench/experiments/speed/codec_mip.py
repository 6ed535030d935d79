"""MIP: CPU time of codec and decoder per packet, compared with the vendor's library `pymscl`.

The library reads a serial port in its own threads. Therefore, codec and library alternately read
the same packets from a pseudo-terminal (pty), and convert all fields to numbers. The result is the
processor time of the whole process.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pty
import statistics
import struct
import termios
import time
import tty
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_protocols import mip
from jointfit_protocols.mip.data import (
    DataSet,
    FilterField,
    SharedField,
    decode_field,
    encode_field,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.driver import Decoder

N = 500
PERIOD_NS = 5_000_000
PACKETS = [
    mip.encode(
        DataSet.FILTER,
        (
            encode_field(DataSet.FILTER, SharedField.REFERENCE_TIME, k * PERIOD_NS),
            encode_field(DataSet.FILTER, FilterField.QUATERNION, 0.5, -0.5, 0.1, 0.7, 1),
        ),
    )
    for k in range(N)
]
BATCH = 50
"""Number of packets on the pty at once: 1.8 kB, much less than its buffer."""
_WAIT_MS = 5


def _decoder() -> Decoder:
    driver = find_driver("mip")
    settings = driver.Settings(id="S1", segment="thigh", driver="mip", port="p", rate_hz=200)
    return driver(settings).decoder()


def own_rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one packet per chunk."""
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(PACKETS)]
    decoder = _decoder()
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, ImuSample) for item in given) == N

    def codec() -> Callable[[], object]:
        fresh = mip.MipCodec()
        return lambda: [fresh.feed(data) for data in PACKETS]

    def whole() -> Callable[[], object]:
        fresh = _decoder()
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    return [
        per_item("mip: codec, one packet", codec, items=N, goal_us=6, quick=quick),
        per_item("mip: bytes to SI sample", whole, items=N, goal_us=20, quick=quick),
    ]


class _Line:
    """Pseudo-terminal (pty) that receives the packets of one batch at the other end."""

    def __init__(self) -> None:
        self._far, self.near = pty.openpty()
        tty.setraw(self.near)
        self.path = os.ttyname(self.near)

    def send(self) -> None:
        data = b"".join(PACKETS[:BATCH])
        assert os.write(self._far, data) == len(data)

    def wait(self) -> None:
        """Wait until this end can read the batch."""
        until = time.monotonic() + 5.0
        while time.monotonic() < until:
            (count,) = struct.unpack("i", fcntl.ioctl(self.near, termios.FIONREAD, bytes(4)))
            if count >= sum(map(len, PACKETS[:BATCH])):
                return
            time.sleep(0.001)

    def close(self) -> None:
        os.close(self._far)
        os.close(self.near)


def _read_ours(line: _Line, codec: mip.MipCodec) -> float:
    """Return the processor time of one batch with our codec, from the port to numbers, s."""
    began = time.process_time()
    line.send()
    line.wait()
    packets = codec.feed(os.read(line.near, 65536))
    values = [
        decode_field(packet.descriptor_set, descriptor, data)
        for packet in packets
        if isinstance(packet, mip.MipPacket)
        for descriptor, data in packet.fields
    ]
    took = time.process_time() - began
    assert len(values) == 2 * BATCH
    return took


def _read_theirs(line: _Line, node: Any) -> float:
    """Return the processor time of one batch with pymscl, from the port to numbers, s."""
    began = time.process_time()
    line.send()
    values: list[object] = []
    found, until = 0, time.monotonic() + 5.0
    while found < BATCH and time.monotonic() < until:
        for packet in node.getDataPackets(BATCH, _WAIT_MS):
            found += 1
            for point in packet.data():
                if point.channelName() == "estOrientQuaternion":
                    quaternion = point.as_Vector()
                    values.append([quaternion.as_floatAt(k) for k in range(4)])
                else:
                    values.append(point.as_double())
    took = time.process_time() - began
    assert found == BATCH
    return took


def rows(quick: bool) -> list[Result]:
    package = import_module("mscl")  # tests use this package as a reference
    ours: list[float] = []
    theirs: list[float] = []
    line, other = _Line(), _Line()
    connection = package.Connection.Serial(other.path, 115_200)
    node = package.InertialNode(connection)
    try:
        for _ in range(repeats(quick)):  # both libraries alternate
            codec = mip.MipCodec()
            gc.collect()
            ours.append(_read_ours(line, codec) / BATCH)
            theirs.append(_read_theirs(other, node) / BATCH)
    finally:
        connection.disconnect()
        line.close()
        other.close()

    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    own_us, peer_us = (round(statistics.median(one) * 1e6, 2) for one in (ours, theirs))
    return [
        *own_rows(quick),
        timed_result("mip: jointfit, one packet from a pty to numbers", own_us, "µs"),
        timed_result("mip: pymscl, one packet from a pty to numbers", peer_us, "µs"),
        timed_result("mip: time ratio of jointfit to pymscl", round(ratio, 4), "", 0.7, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("mip-codec", "MIP: codec and decoder, with a peer", rows),
        packages=("mscl",),
    ),
)
