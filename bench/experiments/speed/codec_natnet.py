"""NatNet: CPU time of codec and decoder per frame, compared with the package `natnet`."""

from __future__ import annotations

import gc
import statistics
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from bench.subjects import device_bytes
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_protocols import natnet
from jointfit_simulators.body import CLUSTERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 500
PERIOD_NS = 8_333_333
DATAGRAMS = device_bytes.natnet_datagrams(N, PERIOD_NS)
MARKERS = sum(map(len, CLUSTERS.values()))
HEADER_BYTES = 4
"""Size of message number and message size, bytes."""


def _codec() -> Callable[[], object]:
    return lambda: [natnet.decode_frame(data, device_bytes.BITSTREAM) for data in DATAGRAMS]


def _decoder() -> Callable[[], object]:
    driver = find_driver("natnet")
    settings = driver.Settings(
        driver="natnet",
        server="127.0.0.1",
        up_axis="y",
        markers={part: names for part, names in CLUSTERS.items() if part != "plate"},
        plate="Plate",
    )
    decoder = driver(settings).decoder()
    for data in device_bytes.natnet_opening():
        decoder.feed(Chunk(0, data))
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(DATAGRAMS, 1)]
    return lambda: [decoder.feed(chunk) for chunk in chunks]


def _peer() -> Callable[[], object]:
    """Return a function that reads the same frames with the package."""
    frame_of = import_module("natnet.data_frame").DataFrame.read_from_buffer
    buffer_of = import_module("natnet.packet_buffer").PacketBuffer
    version = import_module("natnet.version").Version(*device_bytes.BITSTREAM)
    payloads = [data[HEADER_BYTES:] for data in DATAGRAMS]

    def read() -> None:
        for data in payloads:
            frame = frame_of(buffer_of(data), version)
            assert len(frame.rigid_bodies) == len(CLUSTERS)
            assert len(frame.labeled_markers) == MARKERS

    return read


def own_rows(quick: bool) -> list[Result]:
    """Measure the codec and the whole decoder with one frame per chunk."""
    found = _decoder()()
    assert isinstance(found, list)
    assert sum(isinstance(item, MocapFrame) for items in found for item in items) == N

    size = f"{len(CLUSTERS)} bodies, {MARKERS} markers"
    return [
        per_item("natnet: codec, one frame", _codec, items=N, goal_us=60, quick=quick, note=size),
        per_item("natnet: bytes to MocapFrame", _decoder, items=N, goal_us=150, quick=quick),
    ]


def rows(quick: bool) -> list[Result]:
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        for prepare, took in ((_codec, ours), (_peer, theirs)):
            work = prepare()
            gc.collect()
            took.append(cpu_s(work) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)
    return [
        *own_rows(quick),
        timed_result("natnet: the package natnet, one frame", peer_us, "µs"),
        timed_result("natnet: time ratio to the package", round(ratio, 4), "", 0.5, 1.0),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("natnet-codec", "NatNet: codec and decoder, with a peer", rows),
        packages=("natnet",),
    ),
)
