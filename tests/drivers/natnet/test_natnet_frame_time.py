"""Times of NatNet frames: PTP time stamps and timecodes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import ClockEcho, DeviceEvent, MocapFrame, TickClock
from jointfit_protocols.natnet import (
    DECIDING,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    ModelDefinition,
    PrecisionTime,
    ServerInfo,
    timecode_of,
)
from jointfit_protocols.natnet._frame_time import Timecode
from tests.drivers.natnet.feeder import INFO, MODEL, Feeder, described, frame, told

if TYPE_CHECKING:
    from collections.abc import Sequence

NS = 10**9
SECONDS = 1_790_000_000
NEWER = ServerInfo(INFO.application, INFO.application_version, (4, 1, 0, 0), INFO.clock_hz)
NAMED = ModelDefinition((described("Thigh", 1, "T1", "T2", "T3", named=True),))
FRAMES = 3 * DECIDING


def frames_of(feeder: Feeder) -> list[MocapFrame]:
    return [event for event in feeder.events if isinstance(event, MocapFrame)]


def streamed(precision: Sequence[tuple[int, int] | None], **settings: str) -> Feeder:
    feeder = Feeder(version=(4, 1), **settings)
    feeder(NEWER, NAMED)
    for number, stamp in enumerate(precision):
        feeder(frame(number + 1, precision=stamp))
    return feeder


def every_third_of_a_second(unit: int) -> list[tuple[int, int]]:
    return [(SECONDS + k // 3, k % 3 * unit // 3) for k in range(FRAMES)]


def test_the_unit_of_time_fractions_is_detected() -> None:
    for unit in (NS, 2**32):
        found = frames_of(streamed(every_third_of_a_second(unit), time="utc"))
        ticks = [f.ticks for f in found if f.ticks is not None]
        true = [SECONDS * NS + k * NS // 3 for k in range(FRAMES)][-len(ticks) :]
        assert all(abs(a - b) <= 1 for a, b in zip(ticks, true, strict=True))
        assert len(ticks) >= FRAMES - DECIDING + 1
        assert len(ticks) > FRAMES - 4 or unit == NS  # units of 2^-32 s are detected early


def test_a_clock_on_ptp_is_unix_time_less_the_leap_seconds() -> None:
    utc, ptp = (
        streamed(every_third_of_a_second(2**32), time=time) for time in ("utc", "ptp")
    )  # fmt: skip
    assert utc.decoder.tick_clock == ptp.decoder.tick_clock == TickClock(1, None, None, "unix")
    ahead = frames_of(utc)[-1].ticks
    behind = frames_of(ptp)[-1].ticks
    assert ahead is not None
    assert behind is not None
    assert ahead - behind == 37 * NS


def test_frames_without_precision_timestamps_have_no_time_and_a_warning() -> None:
    feeder = streamed([None] * FRAMES, time="ptp")
    assert {found.ticks for found in frames_of(feeder)} == {None}
    assert feeder.decoder.tick_clock is None
    (warning,) = told(feeder.events, "warning")
    assert 'time = "server"' in warning.text


def test_echoes_of_the_servers_counter_do_not_reach_a_clock_on_ptp() -> None:
    for time, echoes in (("server", 1), ("ptp", 0)):
        feeder = streamed([], time=time)
        feeder(EchoRequest(5), t_ns=1000)
        feeder(EchoResponse(5, 77), t_ns=2000)
        assert sum(isinstance(event, ClockEcho) for event in feeder.events) == echoes


def test_by_default_the_servers_counter_is_the_clock() -> None:
    feeder = streamed(every_third_of_a_second(NS))
    assert [found.ticks for found in frames_of(feeder)][:2] == [1000, 2000]
    assert feeder.decoder.tick_clock == TickClock(0, None, INFO.clock_hz)


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)), max_size=60))
def test_any_timestamp_is_read_or_left_out(stamps: list[tuple[int, int]]) -> None:
    time = PrecisionTime()
    for stamp in stamps:
        found = time.ns(stamp)
        assert found is None or 0 <= found - stamp[0] * NS < NS


def test_begin_and_end_of_a_timecode_are_reported() -> None:
    feeder = Feeder()
    feeder(INFO, MODEL)
    for number, code in enumerate([0, 0x0A141E04, 0x0A141E05, 0], 1):
        feeder(frame(number, timecode=code))
    said = [
        (event.text, event.data["timecode_frame"])
        for event in feeder.events
        if isinstance(event, DeviceEvent) and "timecode" in event.data
    ]
    assert said == [("timecode 10:20:30:04", 2), ("timecode lost", None)]


@given(st.tuples(*[st.integers(0, 255)] * 4), st.integers(0, 100))
def test_a_timecode_lies_in_the_bytes_from_the_highest(
    parts: tuple[int, int, int, int], subframe: int
) -> None:
    """The bytes are hours, minutes, seconds and frames."""
    found = timecode_of(
        FrameOfData(
            1, 0.0, 1, 2, 3, timecode=int.from_bytes(bytes(parts), "big"), subframe=subframe
        )
    )
    assert found == (Timecode(*parts, subframe) if any(parts) or subframe else None)
