"""Mocap with PTP stamps in the core: stamps are independent of steps of UNIX time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk, MocapFrame
from jointfit_daemon.outputs.recording import encode_state
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    ChunkArrived,
    Configured,
    Notice,
    SourceOpened,
    UnixOffset,
)
from jointfit_protocols.natnet import FrameOfData, ModelDefinition, ServerInfo
from jointfit_protocols.natnet import encode as encode_natnet
from tests.outputs.recording.recorded_events import after_recording
from tests.pipeline.core_feed import (
    BEGIN_NS,
    MS,
    PERIOD_NS,
    SENSORS,
    Bench,
    chunk,
    replay_states,
    table,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.pipeline.events import Event
    from jointfit_daemon.pipeline.sources import SourceState, StampedMeasurement

S = 1_000_000_000
BITSTREAM = (4, 1)
UNIX_NS = 1_795_250_000 * S - BEGIN_NS
"""UNIX time, and UTC of the PTP grandmaster, minus the time of the host clock, ns."""
TAI_NS = 37 * S
HOUR_NS = 3_600 * S


class UnixTimeCore(Core):
    """Records every stamp of a mocap frame, with the clock's health at that time."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[tuple[int, int, bool, str]] = []
        """Frame number, stamp, whether synced, state of the clock."""

    @override
    def _process(self, source: str, state: SourceState, items: list[Any]) -> list[Any]:
        for item in items:
            measured: MocapFrame | None = getattr(item, "measurement", None)
            if isinstance(measured, MocapFrame):
                self._note(item, measured, state)
        return super()._process(source, state, items)

    def _note(self, item: StampedMeasurement, frame: MocapFrame, state: SourceState) -> None:
        stamp = item.stamp
        self.frames.append((frame.number or 0, stamp.t_ns, stamp.synced, state.clock.state))


def frame(number: int) -> ChunkArrived:
    """Return camera frame `number`, which arrives 6 ms after the instant of sample `number`."""
    t_ns = BEGIN_NS + number * PERIOD_NS
    told = divmod(t_ns + UNIX_NS + TAI_NS, S)
    data = FrameOfData(number, 0.0, number, number + 1, number + 2, precision=told)
    return ChunkArrived("mocap", Chunk(t_ns + 6 * MS, encode_natnet(data, BITSTREAM)))


@dataclass
class UnixTimeRig:
    """Four IMUs and cameras on PTP, and a host whose UNIX time may be set."""

    core: UnixTimeCore = field(default_factory=UnixTimeCore)
    number: int = 0

    def __post_init__(self) -> None:
        self.bench = Bench(core=self.core)
        layout = table()
        layout["mocap"]["time"] = "ptp"
        rig = parse_rig(layout)
        self.bench.feed([Configured(BEGIN_NS, rig, None)])

    def start(self, offset_ns: int = UNIX_NS) -> None:
        """Open all sources and set the UNIX offset."""
        info = ServerInfo("Motive", (3, 1, 0, 0), (*BITSTREAM, 0, 0), 10_000_000)
        words = (encode_natnet(info, BITSTREAM), encode_natnet(ModelDefinition(()), BITSTREAM))
        opened: list[Event] = [UnixOffset(BEGIN_NS, offset_ns)]
        opened += [SourceOpened(BEGIN_NS, name) for name in (*SENSORS, "mocap")]
        self.bench.feed(opened)
        self.bench.feed([ChunkArrived("mocap", Chunk(BEGIN_NS, word)) for word in words])

    def stream(self, seconds: float) -> None:
        """Feed the data of all sources for this duration, s."""
        self.bench.feed(self._events(round(seconds * S / PERIOD_NS)))

    def _events(self, count: int) -> Iterator[Event]:
        for number in range(self.number, self.number + count):
            yield from (chunk(name, number) for name in ("S2", "S1", "S3", "S4"))
            yield frame(number)
        self.number += count

    def set_unix_time(self, offset_ns: int) -> None:
        """Report another offset of UNIX time to the core."""
        self.bench.feed([UnixOffset(BEGIN_NS + self.number * PERIOD_NS, offset_ns)])

    def state(self) -> str:
        """Return the state of the mocap clock in the health message."""
        return str(self.bench.devices()["mocap"]["clock"])

    def errors_ms(self, since: int) -> list[float]:
        """Return the errors of synced camera stamps from frame `since` on, ms."""
        return [
            (t_ns - BEGIN_NS - number * PERIOD_NS) / MS
            for number, t_ns, synced, _ in self.core.frames
            if synced and number >= since
        ]

    def notices(self) -> list[Notice]:
        """Return the warnings, except those about rigid bodies."""
        notices = [n for n in self.bench.out if isinstance(n, Notice) and n.level == "warning"]
        return [n for n in notices if "rigid body" not in n.text]


@pytest.fixture
def rig() -> UnixTimeRig:
    return UnixTimeRig()


def test_ptp_mocap_stamps_are_exact_and_health_reports_direct(rig: UnixTimeRig) -> None:
    rig.start()
    rig.stream(6)
    assert rig.state() == "direct"
    assert set(rig.errors_ms(30)) == {0.0}
    assert len(rig.errors_ms(30)) == rig.number - 30
    assert not rig.notices()


def test_ptp_stamps_are_unused_without_unix_time(rig: UnixTimeRig) -> None:
    rig.start()
    rig.core._unix_offset_ns = None
    for state in rig.core._sources.values():
        state.clock._unix_offset_ns = None
    rig.stream(6)
    assert rig.state() == "passive"


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS, 40 * MS, -40 * MS])
def test_wrong_unix_time_moves_no_stamp_and_is_used_again_when_corrected(
    rig: UnixTimeRig, step_ns: int
) -> None:
    rig.start()
    rig.stream(6)
    rig.set_unix_time(UNIX_NS + step_ns)
    rig.stream(6)
    assert rig.state() == "passive"
    rig.set_unix_time(UNIX_NS)
    rig.stream(16)  # meanwhile, slewing removes the error of the passive time
    assert rig.state() == "direct"
    assert max(map(abs, rig.errors_ms(30))) < 4.1  # the delay is 6 ms, assumed 10 ms
    assert rig.errors_ms(rig.number - 10) == [0.0] * 10
    stamps = [t_ns for _, t_ns, _, _ in rig.core.frames]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    out = [state.t_ns for state in rig.bench.states]
    assert all(b - a == PERIOD_NS for a, b in itertools.pairwise(out))
    told = [(n.id, n.data.get("step_s")) for n in rig.notices() if n.id == "host"]
    assert told == [("host", step_ns / 1e9), ("host", -step_ns / 1e9)]
    assert sum("sync time differs" in n.text for n in rig.notices()) == 1


def test_start_with_a_wrong_date_gives_no_wrong_sync(rig: UnixTimeRig) -> None:
    rig.start(UNIX_NS - 5 * HOUR_NS)
    rig.stream(4)
    assert rig.state() in {"settling", "passive"}
    rig.set_unix_time(UNIX_NS)
    rig.stream(16)
    assert rig.state() == "direct"
    assert max(map(abs, rig.errors_ms(0))) < 4.1
    assert rig.errors_ms(rig.number - 10) == [0.0] * 10


def test_reload_preserves_the_unix_offset(rig: UnixTimeRig) -> None:
    rig.start()
    rig.stream(1)
    layout = table()
    layout["mocap"] |= {"time": "ptp", "tai_minus_utc_s": 36}
    t_ns = BEGIN_NS + rig.number * PERIOD_NS
    rig.bench.feed([Configured(t_ns, parse_rig(layout), None)])
    clock = rig.core._sources["mocap"].clock
    assert clock._unix_offset_ns == UNIX_NS


def test_steps_of_unix_time_replay_byte_for_byte(rig: UnixTimeRig) -> None:
    rig.start()
    rig.stream(3)
    rig.set_unix_time(UNIX_NS + HOUR_NS)
    rig.stream(3)
    logged = after_recording(rig.bench.fed)
    again = [encode_state(state) for state in replay_states(logged)]
    assert again == [encode_state(state) for state in rig.bench.states]
    assert sum(isinstance(event, UnixOffset) for event in logged) == 2
