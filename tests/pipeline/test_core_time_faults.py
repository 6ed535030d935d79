"""Time faults from bytes to limb states: order of frames, notices and recovery."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typing_extensions import override

from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Notice, SourceClosed, SourceOpened
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.xbus import XbusMessageId
from jointfit_protocols.xbus import encode as encode_xbus
from jointfit_protocols.xbus.mtdata2 import Item, encode_items
from jointfit_protocols.xcdi import DataId, quaternion_counts
from jointfit_protocols.xcdi import encode as encode_xcdi
from tests.pipeline.core_feed import (
    BEGIN_NS,
    DELAYS_NS,
    IDS,
    MS,
    PERIOD_NS,
    SENSORS,
    XBUS,
    Bench,
    arrival_ns,
    opening,
    orientation,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import LimbState
    from jointfit_daemon.pipeline.events import Event
    from jointfit_daemon.timing.alignment import AlignedFrame

NS = 1_000_000_000
TICK_NS = 100_000
WRAP = 2**32
BOOTED_NS = -1_000 * NS
"""Start time of the device clocks, ns: a thousand seconds before the run."""
FAULT, COUNT = 400, 1_200
"""Number of samples before the fault (four seconds) and of the run (twelve seconds)."""
RECOVERY_NS = 6 * NS
VERDICTS = ("used", "decimated", "idle", "late", "duplicate", "dropped")


@dataclass
class Sent:
    """One sample of a device; a fault changes its fields before it is written."""

    name: str
    number: int
    taken_ns: int
    device_ns: int
    counter: int
    arrival_ns: int = 0
    copies: int = 1
    timed: bool = True
    """Whether a CAN device sends its time."""

    def chunks(self) -> list[ChunkArrived]:
        ticks, q = self.device_ns // TICK_NS % WRAP, orientation(self.name, self.number)
        counter = self.counter % 65536
        if self.name in XBUS:
            items: list[tuple[int, Any]] = [
                (Item.PACKET_COUNTER, counter),
                (Item.SAMPLE_TIME_FINE, ticks),
                (Item.QUATERNION, q),
            ]
            data = encode_xbus(XbusMessageId.MT_DATA2, encode_items(items))
        else:
            rows = zip(
                IDS[self.name],
                (DataId.SAMPLE_TIME, DataId.GROUP_COUNTER, DataId.QUATERNION),
                ((ticks,), (counter,), quaternion_counts(q)),
                strict=True,
            )
            data = pack_frames(
                [
                    CanFrame(self.arrival_ns, i, encode_xcdi(kind, n))
                    for i, kind, n in rows
                    if self.timed or kind != DataId.SAMPLE_TIME
                ]
            )
        return [ChunkArrived(self.name, Chunk(self.arrival_ns, data))] * self.copies


class TimeFaultCore(Core):
    """Core that stores its frames, because uncalibrated states do not name the sensors."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[AlignedFrame] = []

    @override
    def _fuse(self, frame: AlignedFrame) -> LimbState:
        self.frames.append(frame)
        return super()._fuse(frame)


@dataclass
class Lived:
    """Result of a run."""

    states: list[LimbState]
    frames: list[AlignedFrame]
    """Frames, one per limb state."""
    notices: list[Notice]
    devices: dict[str, Any]
    fault_ns: int

    def between(self, begin_ns: int, end_ns: int) -> list[tuple[str, AlignedFrame]]:
        """Return sync state and frame of the outputs in an interval, ns since the fault."""
        return [
            (state.sync, frame)
            for state, frame in zip(self.states, self.frames, strict=True)
            if begin_ns <= state.completed_ns - self.fault_ns < end_ns
        ]

    def sync_with(self, name: str, begin_ns: int, end_ns: int) -> set[str]:
        """Return the sync states of the frames in this interval that contain the sensor."""
        return {
            sync for sync, frame in self.between(begin_ns, end_ns) if name in frame.orientations
        }


def live(
    fault: Callable[[Sent], Sent | None],
    more: tuple[Event, ...] = (),
    count: int = COUNT,
    untimed: str = "",
) -> Lived:
    """Run four sensors; `fault` may change or drop every sample from number FAULT on.

    A CAN sensor that is `untimed` has a counter but no clock.
    """
    events: list[Event] = list(more)
    for name in SENSORS:
        skew = 1 + 2e-5 * SENSORS.index(name)
        for number in range(count):
            taken_ns = BEGIN_NS + number * PERIOD_NS
            late_ns = DELAYS_NS[name] + (number * 7919 % 97) * 10_000
            sent: Sent | None = Sent(
                name, number, taken_ns, round((taken_ns - BOOTED_NS) * skew), number,
                timed=name != untimed,
            )  # fmt: skip
            if number >= FAULT and sent is not None:
                sent = fault(sent)
            if sent is not None:
                sent.arrival_ns = sent.arrival_ns or taken_ns + late_ns
                events += sent.chunks()
    core = TimeFaultCore()
    bench = Bench(core)
    bench.feed(opening(mocap=False))
    bench.feed(sorted(events, key=arrival_ns))
    notices = [output for output in bench.out if isinstance(output, Notice)]
    fault_ns = BEGIN_NS + FAULT * PERIOD_NS
    return Lived(bench.states, core.frames, notices, bench.devices(), fault_ns)


def assert_sane(run: Lived) -> None:
    """Assert ordered frames and exactly one outcome for each sample."""
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(run.states))
    assert all(a.completed_ns <= b.completed_ns for a, b in itertools.pairwise(run.states))
    assert [state.seq for state in run.states] == list(range(1, len(run.states) + 1))
    for name, device in run.devices.items():
        if name != "mocap":
            accounted = sum(device[key] for key in (*VERDICTS, "pending"))
            assert device["received"] == accounted, (name, device)


def assert_healed(run: Lived, after_ns: int = RECOVERY_NS) -> None:
    """Assert that frames become complete, timely and synced again without help."""
    healed = run.between(after_ns, 60 * NS)
    assert len(healed) > 100
    assert {sync for sync, _ in healed} == {"locked"}
    frames = [frame for _, frame in healed]
    assert {len(frame.orientations) for frame in frames} == {len(SENSORS)}
    assert max(frame.completed_ns - frame.t_ns for frame in frames) < 40 * MS


def told(run: Lived, name: str) -> list[str]:
    """Return the texts of the notices about the clock of the sensor `name`."""
    return [n.text for n in run.notices if n.kind == "clock" and n.id == name]


def rebooted(sent: Sent) -> Sent | None:
    """Return the sample after a power failure of a second; clock and counter restart."""
    if sent.name != "S3":
        return sent
    if sent.number < FAULT + 100:
        return None
    sent.device_ns = sent.taken_ns - (BEGIN_NS + (FAULT + 90) * PERIOD_NS)
    sent.counter = sent.number - FAULT - 100
    return sent


def test_device_restart_is_reported_and_settles_before_it_is_synced() -> None:
    run = live(rebooted)
    assert_sane(run)
    assert_healed(run)
    assert len(told(run, "S3")) == 1
    assert not told(run, "S1")
    assert run.sync_with("S3", 1_050 * MS, 2_500 * MS) == {"settling"}
    assert run.devices["S3"]["epoch"] == 1


@pytest.mark.parametrize("jump_s", [-3.0, -0.2, 0.2, 3.0, 600.0])
def test_device_clock_jump_is_reported_and_settles_again(jump_s: float) -> None:
    def jumped(sent: Sent) -> Sent:
        if sent.name == "S2":
            sent.device_ns += round(jump_s * NS)
        return sent

    run = live(jumped)
    assert_sane(run)
    assert_healed(run)
    assert told(run, "S2"), run.notices
    assert not told(run, "S4")
    assert run.devices["S2"]["epoch"] >= 1
    assert run.sync_with("S2", 100 * MS, 1_500 * MS) == {"settling"}


@pytest.mark.parametrize("asleep_s", [0.5, 30.0, 7_200.0])
def test_all_clocks_settle_again_after_suspend(asleep_s: float) -> None:
    """CLOCK_MONOTONIC stops during suspend, but the device clocks continue."""

    def slept(sent: Sent) -> Sent:
        sent.device_ns += round(asleep_s * NS)
        sent.counter += round(asleep_s * NS) // PERIOD_NS
        return sent

    run = live(slept)
    assert_sane(run)
    assert_healed(run)
    assert all(told(run, name) for name in SENSORS)
    assert {sync for sync, _ in run.between(100 * MS, 1_500 * MS)} == {"settling"}


def test_all_clocks_settle_again_after_suspend_with_lost_ports() -> None:
    """Drivers detect a loss and reconnect a second later, as they do after a real suspend."""

    def slept(sent: Sent) -> Sent | None:
        sent.device_ns += 3_600 * NS
        return None if sent.number < FAULT + 100 else sent

    lost_ns = BEGIN_NS + FAULT * PERIOD_NS + 20 * MS
    events: list[Event] = []
    for name in SENSORS:
        events.append(SourceClosed(lost_ns, name, "lost", "silent"))
        events.append(SourceOpened(lost_ns + 900 * MS, name))
    run = live(slept, tuple(events))
    assert_sane(run)
    assert_healed(run)
    assert {sync for sync, _ in run.between(950 * MS, 2_500 * MS)} == {"settling"}


def test_stall_of_the_host_starts_no_new_epoch() -> None:
    """After half a second without CPU, all samples arrive at once, with right device times."""

    def delayed(sent: Sent) -> Sent:
        until_ns = BEGIN_NS + (FAULT + 50) * PERIOD_NS
        sent.arrival_ns = until_ns if sent.taken_ns < until_ns else 0
        return sent

    run = live(delayed)
    assert_sane(run)
    assert_healed(run, 500 * MS + 200 * MS)
    assert all(run.devices[name]["epoch"] == 0 for name in SENSORS)
    assert {sync for sync, _ in run.between(0, 10 * NS)} == {"locked"}


def test_repeated_stamps_are_duplicates_without_effect_on_frames() -> None:
    def repeated(sent: Sent) -> Sent:
        if sent.name == "S1" and sent.number % 10 == 0:
            sent.device_ns -= PERIOD_NS  # the time of the previous sample
        return sent

    def twice(sent: Sent) -> Sent:
        sent.copies = 2 if sent.name == "S4" else 1
        return sent

    for fault, name, least in ((repeated, "S1", 75), (twice, "S4", 750)):
        run = live(fault)
        assert_sane(run)
        assert_healed(run, 0)
        device = run.devices[name]
        assert device["epoch"] == 0
        assert device["duplicate"] + device["dropped"] >= least, device


@pytest.mark.parametrize("jump", [7, 30_000, 65_530])
def test_counter_jump_alone_changes_no_stamp(jump: int) -> None:
    def jumped(sent: Sent) -> Sent:
        if sent.name == "S1":
            sent.counter += jump
        return sent

    run = live(jumped)
    assert_sane(run)
    assert_healed(run)
    assert max(frame.completed_ns - frame.t_ns for _, frame in run.between(0, NS)) < 40 * MS
    assert "wire" in {n.kind for n in run.notices if n.id == "S1"}


@pytest.mark.parametrize("jump", [-30_000, -20, 20, 30_000])
def test_counter_jump_without_device_clock_is_reported_and_settles_again(jump: int) -> None:
    def jumped(sent: Sent) -> Sent:
        if sent.name == "S4":
            sent.counter += jump
        return sent

    run = live(jumped, untimed="S4")
    assert_sane(run)
    assert_healed(run)
    assert told(run, "S4"), run.notices
    assert not told(run, "S2")
    assert run.sync_with("S4", 100 * MS, 1_500 * MS) == {"settling"}


# --- any mixture of these faults ----------------------------------------------------------------


FAULTS: dict[str, Callable[[Sent, int], Sent | None]] = {}


def fault(change: Callable[[Sent, int], Sent | None]) -> Callable[[Sent, int], Sent | None]:
    FAULTS[change.__name__] = change
    return change


@fault
def lost(_sent: Sent, _size: int) -> None:
    return None


@fault
def late(sent: Sent, size: int) -> Sent:
    sent.arrival_ns = sent.taken_ns + DELAYS_NS[sent.name] + size * MS
    return sent


@fault
def shifted(sent: Sent, size: int) -> Sent:
    sent.device_ns += (size - 100) * 20 * MS
    return sent


@fault
def counted_on(sent: Sent, size: int) -> Sent:
    sent.counter += size
    return sent


@fault
def doubled(sent: Sent, size: int) -> Sent:
    sent.copies = 1 + size % 3
    return sent


troubles = st.lists(
    st.tuples(
        st.sampled_from(sorted(FAULTS)),
        st.sampled_from(SENSORS),
        st.integers(0, 200),  # first affected sample, counted from FAULT
        st.integers(1, 120),  # number of affected samples
        st.integers(1, 200),  # size of the fault
    ),
    max_size=6,
)


@pytest.mark.timeout(120)  # ten seconds on an idle machine
@settings(max_examples=6)
@given(troubles)
def test_recovery_from_any_sequence_of_time_faults(
    script: list[tuple[str, str, int, int, int]],
) -> None:
    def change(sent: Sent) -> Sent | None:
        found: Sent | None = sent
        for kind, name, first, length, size in script:
            if found and sent.name == name and first <= sent.number - FAULT < first + length:
                found = FAULTS[kind](found, size)
        return found

    run = live(change, count=FAULT + 1_300)
    assert_sane(run)
    assert_healed(run, 10 * NS)


@cache
def undisturbed() -> Lived:
    return live(lambda sent: sent)


def test_healthy_clocks_give_no_notice() -> None:
    run = undisturbed()
    assert_sane(run)
    assert_healed(run, 0)
    assert not [n for n in run.notices if n.kind == "clock"]
