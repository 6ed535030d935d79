"""LSL markers: CPU time of codec and decoder per sample, compared with pylsl on the same stream.

pylsl receives the samples of a simulated program over the network of this host. The result contains
the CPU time of the thread that takes the samples from pylsl, but not the CPU time of the threads in
which liblsl receives them.
"""

from __future__ import annotations

import gc
import os
import statistics
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import cpu_s, per_item, repeats, speed_experiment, timed_result
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_protocols.lsl import LslCodec, Samples, encode_description, encode_samples
from jointfit_simulators.devices import LslServer, LslServerOptions

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result

N = 400
PERIOD_NS = 10_000_000
BODIES = tuple(f"Body{number}" for number in range(5))
LONGEST_WAIT_S = 10.0
"""Longest wait for the samples of one repetition, s."""


class _Stream:
    """A simulated program, and a pylsl inlet that is connected to it."""

    def __init__(self) -> None:
        import pylsl  # noqa: PLC0415 - an extra

        source = f"bench-{os.getpid()}"
        self._server = LslServer(LslServerOptions(bodies=BODIES, source_id=source))
        found = pylsl.resolve_byprop("source_id", source, timeout=LONGEST_WAIT_S)
        if not found:
            raise RuntimeError("LSL finds no stream on this host: allow multicast on its network")
        self.inlet: Any = pylsl.StreamInlet(found[0])
        self.inlet.open_stream(timeout=LONGEST_WAIT_S)
        self.description = encode_description(self.inlet.info(timeout=LONGEST_WAIT_S).as_xml())

    def send(self) -> None:
        """Send samples, and wait until liblsl has received them."""
        for k in range(N):
            turn = (0.6, 0.0, 0.0, 0.8)
            bodies = {name: ((0.1 * at, 1.0, k / N), turn) for at, name in enumerate(BODIES)}
            self._server.push(time.monotonic_ns(), {}, bodies)
        until = time.monotonic() + LONGEST_WAIT_S
        while self.inlet.samples_available() < N and time.monotonic() < until:
            time.sleep(0.01)

    def take(self) -> list[tuple[list[float], float]]:
        """Return the samples that pylsl has received."""
        return [self.inlet.pull_sample(timeout=0.0) for _ in range(N)]


def rows(quick: bool) -> list[Result]:
    stream = _Stream()
    stream.send()
    received = stream.take()
    wire = [encode_samples("double64", (stamp,), (values,)) for values, stamp in received]
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(wire, 1)]
    driver = find_driver("lsl-markers")
    settings = driver.Settings(driver="lsl-markers", up_axis="y")

    def codec() -> Callable[[], object]:
        fresh = LslCodec()
        fresh.feed(stream.description)
        return lambda: [fresh.feed(data) for data in wire]

    def whole() -> Callable[[], object]:
        fresh = driver(settings).decoder()
        fresh.feed(Chunk(0, stream.description))
        return lambda: [fresh.feed(chunk) for chunk in chunks]

    # Check that the codec and pylsl read the same samples.
    check = LslCodec()
    check.feed(stream.description)
    own = [message for data in wire for message in check.feed(data)]
    for message, (values, stamp) in zip(own, received, strict=True):
        assert message == Samples((stamp,), (tuple(values),))
    decoder = driver(settings).decoder()
    decoder.feed(Chunk(0, stream.description))
    given = [item for chunk in chunks for item in decoder.feed(chunk)]
    assert sum(isinstance(item, MocapFrame) for item in given) == N

    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(repeats(quick)):  # both libraries alternate
        work = codec()
        stream.send()
        gc.collect()
        ours.append(cpu_s(work) / N)
        theirs.append(cpu_s(stream.take) / N)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    peer_us = round(statistics.median(theirs) * 1e6, 2)

    size = f"{len(BODIES)} bodies, {7 * len(BODIES)} channels"
    return [
        per_item("lsl: codec, one sample", codec, items=N, goal_us=8, quick=quick, note=size),
        per_item("lsl: bytes to MocapFrame", whole, items=N, goal_us=150, quick=quick, note=size),
        timed_result("lsl: pylsl, one sample", peer_us, "µs", note=size),
        timed_result("lsl: time ratio to pylsl", round(ratio, 4), "", 1.0, 1.5),
    ]


EXPERIMENTS = (
    replace(
        speed_experiment("lsl-codec", "LSL markers: codec and decoder, compared with pylsl", rows),
        packages=("pylsl",),
    ),
)
