"""Clock events of sources, sync lines and latency priors in the core."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, ImuSample, SyncPulse, TickClock
from jointfit_daemon.outputs.payloads._health_encoding import core_payload
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, Notice, SourceOpened
from jointfit_daemon.pipeline.sources._latency_prior import latency_prior

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded
    from jointfit_daemon.pipeline.events import Output

MS = 1_000_000
START = 5_000_000_000_000
PERIOD = 10 * MS
OWN = TickClock(1000, 1 << 32)
UNIT = (1.0, 0.0, 0.0, 0.0)


@dataclass
class Spoken:
    """A decoder that returns prepared items; the bytes of a chunk are the index of its items."""

    items: list[list[Decoded]] = field(default_factory=list)
    tick_clock: TickClock | None = OWN
    messages: int = 0
    discarded_bytes: int = 0

    def feed(self, chunk: Chunk) -> list[Decoded]:
        return self.items[int(chunk.data)]

    def flush(self) -> list[Decoded]:
        return []


class SourceClockRig:
    """A core with two sensors whose decoders return prepared items."""

    def __init__(self) -> None:
        table = {
            "rig": {"name": "r"},
            "chain": {"joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"]},
            "imu": [
                {"id": name, "segment": segment, "driver": "xbus", "port": f"/dev/{name}"}
                for name, segment in (("A", "thigh"), ("B", "shank"))
            ],
        }
        rig = parse_rig(table)
        self.decoders: dict[str, Spoken] = {}
        sources = []
        for source in rig.sources:
            self.decoders[source.id] = decoder = Spoken()

            class Told:
                wire = "stream"

                def __init__(self, _: Any, decoder: Spoken = decoder) -> None:
                    self.decoder = lambda: decoder

            sources.append(replace(source, driver_class=Told))  # type: ignore[arg-type] # a fake
        self.core = Core()
        self.out: list[Output] = []
        self.core.feed(Configured(START, replace(rig, sources=tuple(sources)), None))
        for source in sources:
            self.core.feed(SourceOpened(START, source.id))

    def say(self, name: str, t_ns: int, *items: Decoded) -> None:
        decoder = self.decoders[name]
        decoder.items.append(list(items))
        place = str(len(decoder.items) - 1).encode()
        self.out += self.core.feed(ChunkArrived(name, Chunk(t_ns, place)))

    def notices(self, kind: str) -> list[Notice]:
        return [out for out in self.out if isinstance(out, Notice) and out.kind == kind]

    def health(self, name: str, now_ns: int) -> dict[str, Any]:
        devices: Any = core_payload(self.core.health(now_ns))["devices"]
        return dict(devices[name])


def sample(t_ns: int, ticks: int) -> ImuSample:
    return ImuSample(t_ns, UNIT, UNIT, ticks, None)


def test_restart_detected_by_the_clock_alone_is_published_and_counted() -> None:
    rig = SourceClockRig()
    for k in range(1000):
        t = START + k * PERIOD
        ticks = 90_000_000 + k * 10_000 if k < 600 else (k - 590) * 10_000
        rig.say("A", t + MS, sample(t + MS, ticks))
    told = rig.notices("clock")
    assert [notice.id for notice in told] == ["A"]
    assert "rebooted" in told[0].text
    health = rig.health("A", START + 1000 * PERIOD)
    assert (health["epoch"], health["restarts"], health["clock"]) == (1, 1, "passive")
    assert health["rate_hz"] == pytest.approx(100, abs=0.1)
    assert health["delay_us"]["max"] >= health["delay_us"]["p50"] > 0
    assert health["latency_prior_us"] == [200, 200]


def test_sync_line_ties_the_clocks_of_two_sensors() -> None:
    rig = SourceClockRig()
    for k in range(1500):
        t = START + k * PERIOD
        for name, late, rate in (("A", MS, 10_000), ("B", 3 * MS, 10_001)):
            words: list[Decoded] = [sample(t + late, 7_000_000 + k * rate)]
            if k % 10 == 5:
                edge = 7_000_000 + k * rate + rate // 2
                words.append(SyncPulse(t + late + 5 * MS, edge, 3))
            rig.say(name, t + late, *words)
    a, b = (rig.health(name, START + 1500 * PERIOD) for name in "AB")
    assert (a["clock"], b["clock"]) == ("passive", "direct")
    zero_a, zero_b = 7_000_000 + 1499 * 10_000, 7_000_000 + 1499 * 10_001
    assert zero_a + a["offset_us"] == pytest.approx(zero_b + b["offset_us"], abs=10)


def test_latency_prior_depends_on_transport_unless_configured() -> None:
    rig = parse_rig(
        {
            "rig": {"name": "r"},
            "chain": {"joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"]},
            "imu": [
                {"id": "A", "segment": "thigh", "driver": "xbus", "port": "/dev/ttyS1"},
                {"id": "B", "segment": "shank", "driver": "xbus", "port": "/dev/ttyUSB0"},
                {
                    "id": "C", "segment": "shank", "driver": "xbus", "port": "/dev/ttyS2",
                    "least_delay_ms": [4.0, 0.5],
                },
            ],
        }
    )  # fmt: skip
    priors = [latency_prior(source) for source in rig.sources]
    assert priors == [(200_000, 200_000), (1_000_000, 700_000), (4_000_000, 500_000)]
