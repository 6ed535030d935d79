"""Times in a real NatNet capture equal the values that two other parsers found.

The expected values come with the recording. Arrivals are the packet times of the file. An echo is a
request to the server and its answer, which contains the server clock.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from jointfit_daemon.model import Chunk, ClockEcho
from jointfit_daemon.timing.clock._echo_fit import EchoFit
from jointfit_drivers.natnet import NatNetDecoder, NatNetSettings
from jointfit_protocols.natnet import FrameOfData, decode
from tests.captured_datagrams import read_udp

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

NS = 10**9
HZ = 3_312_787
MS = 1e-6  # ns to ms


class Traffic(NamedTuple):
    """Content of the capture."""

    frames: list[tuple[int, FrameOfData]]
    """Each frame with its arrival time, ns."""
    echoes: list[ClockEcho]

    def ticks(self, field: str) -> NDArray[np.int64]:
        return np.array([getattr(frame, field) for _, frame in self.frames], dtype=np.int64)

    @property
    def arrivals(self) -> NDArray[np.int64]:
        return np.array([t for t, _ in self.frames], dtype=np.int64)


@pytest.fixture(scope="module")
def traffic(shared_data: Path) -> Traffic:
    """Return the capture as the driver's decoder reads it."""
    file = shared_data / "mocap" / "natnet_v3_mje-nz" / "test_data" / "raw" / "traffic.pcapng"
    events = NatNetDecoder(NatNetSettings(driver="natnet", server="192.168.0.106"))
    found = Traffic([], [])
    for packet in read_udp(file.read_bytes()):
        message = decode(packet.payload, (3, 0))
        if isinstance(message, FrameOfData):
            found.frames.append((packet.t_ns, message))
        told = events.feed(Chunk(packet.t_ns, packet.payload))
        found.echoes.extend(item for item in told if isinstance(item, ClockEcho))
    assert events.tick_clock is not None
    assert events.tick_clock.ticks_per_s == HZ
    return found


def server_ns(ticks: int) -> int:
    return ticks * NS // HZ


def fitted(echoes: Sequence[ClockEcho]) -> EchoFit:
    fit = EchoFit()
    for echo in echoes:
        fit.feed(server_ns(echo.ticks), echo.sent_ns, echo.received_ns)
    return fit


def test_exposures_are_as_regular_as_cameras_are(traffic: Traffic) -> None:
    """The standard deviation of the frame period is 9 µs."""
    steps_ms = np.diff(traffic.ticks("exposure")) / HZ * 1e3
    assert len(steps_ms) == 517
    assert steps_ms.mean() == pytest.approx(8.333438, abs=1e-6)
    assert steps_ms.std() * 1e3 == pytest.approx(8.96, abs=0.02)
    assert steps_ms.min() == pytest.approx(8.270, abs=0.001)
    assert steps_ms.max() == pytest.approx(8.425, abs=0.001)


def test_the_timestamp_field_is_a_counter_and_no_clock(traffic: Traffic) -> None:
    """The field is the frame number divided by the nominal rate, 120 Hz."""
    numbers = traffic.ticks("number")
    said = np.array([frame.timestamp for _, frame in traffic.frames])
    assert np.abs(said - numbers / 120).max() < 3e-13
    seconds = traffic.ticks("exposure") / HZ
    slope = np.polyfit(numbers - numbers[0], seconds - seconds[0], 1)[0]
    assert (slope * 120 - 1) * 1e6 == pytest.approx(14.8, abs=0.1)
    end_to_end = (seconds[-1] - seconds[0]) / (numbers[-1] - numbers[0])
    assert (end_to_end * 120 - 1) * 1e6 == pytest.approx(12.6, abs=0.1)


@pytest.mark.parametrize(
    ("begin", "end", "expected_ms", "total"),
    [
        ("exposure", "received", (4.5987, 4.4597, 4.9436), 7_891_558),
        ("received", "transmit", (0.8110, 0.4688, 1.1057), 1_391_767),
        ("exposure", "transmit", (5.4098, 5.0860, 5.8944), 9_283_325),
    ],
)
def test_the_stages_of_a_frame_take_their_known_times(
    traffic: Traffic, begin: str, end: str, expected_ms: tuple[float, ...], total: int
) -> None:
    ticks = traffic.ticks(end) - traffic.ticks(begin)
    took_ms = ticks / HZ * 1e3
    assert int(ticks.sum()) == total
    said = (took_ms.mean(), took_ms.min(), took_ms.max())
    assert said == pytest.approx(expected_ms, abs=1e-4)


def test_arrivals_are_less_regular(traffic: Traffic) -> None:
    """The intervals between arrivals vary more than those between exposures."""
    steps_ms = np.diff(traffic.arrivals) * MS
    assert steps_ms.mean() == pytest.approx(8.3343, abs=1e-4)
    assert steps_ms.std() == pytest.approx(0.380, abs=0.001)
    assert steps_ms.min() == pytest.approx(3.837, abs=0.001)
    assert steps_ms.max() == pytest.approx(12.789, abs=0.001)


def test_nine_echoes_determine_the_rate_of_the_server_clock(traffic: Traffic) -> None:
    echoes = traffic.echoes
    trips_ms = np.array([echo.received_ns - echo.sent_ns for echo in echoes]) * MS
    assert trips_ms == pytest.approx(
        [1.156, 0.918, 0.897, 0.936, 1.060, 0.948, 0.927, 0.868, 0.900], abs=0.001
    )
    middle = np.array([(echo.sent_ns + echo.received_ns) // 2 for echo in echoes])
    theta = np.array([server_ns(echo.ticks) for echo in echoes]) - middle
    theta_us = (theta - theta[0]) / 1e3
    assert theta_us.std(ddof=1) == pytest.approx(35, abs=2)
    assert np.ptp(theta_us) == pytest.approx(107, abs=1)
    line = np.polyfit((middle - middle[0]) / NS, theta_us, 1)
    assert line[0] == pytest.approx(-42, abs=12)
    rest = theta_us - np.polyval(line, (middle - middle[0]) / NS)
    assert rest.std(ddof=2) == pytest.approx(23, abs=3)
    assert np.abs(rest).max() == pytest.approx(32, abs=1)
    assert fitted(echoes).slope * 1e6 == pytest.approx(-42, abs=12)


def test_by_the_quickest_echo_frames_travel_their_known_times(traffic: Traffic) -> None:
    """The echo with the shortest round trip gives the offset between server and host clock."""
    quickest = min(traffic.echoes, key=lambda echo: echo.received_ns - echo.sent_ns)
    offset = (quickest.sent_ns + quickest.received_ns) // 2 - server_ns(quickest.ticks)

    def delays_ms(field: str) -> NDArray[np.float64]:
        stamps = np.array([server_ns(int(ticks)) for ticks in traffic.ticks(field)])
        found: NDArray[np.float64] = np.sort((traffic.arrivals - stamps - offset) * MS)
        return found

    transit, whole = delays_ms("transmit"), delays_ms("exposure")
    for found, expected in (
        (transit, (0.416, 0.693, 1.373, 5.523)),
        (whole, (5.670, 6.240, 6.918, 10.929)),
    ):
        said = (found[0], np.median(found), np.percentile(found, 99), found[-1])
        assert said == pytest.approx(expected, abs=0.02)
    assert (transit > 2.01).sum() == 1  # the next smaller value is 2.003 ms


def test_lost_and_late_echoes_leave_the_offset_where_it_was(traffic: Traffic) -> None:
    """In each of 1260 cases, three of the nine echoes are lost, and two others are 20 ms late."""
    echoes = traffic.echoes
    whole = fitted(echoes)
    middle = server_ns((echoes[0].ticks + echoes[-1].ticks) // 2)
    last = server_ns(echoes[-1].ticks)
    moved: list[tuple[int, int]] = []
    for lost in combinations(range(9), 3):
        left = [echo for k, echo in enumerate(echoes) if k not in lost]
        for late in combinations(range(6), 2):
            heard = [
                ClockEcho(echo.sent_ns, echo.received_ns + 20_000_000 * (k in late), echo.ticks)
                for k, echo in enumerate(left)
            ]
            fit = fitted(heard)
            moved.append(
                (
                    abs(fit.host_ns(middle) - whole.host_ns(middle)),
                    abs(fit.host_ns(last) - whole.host_ns(last)),
                )
            )
    at_middle, at_last = np.array(moved).T
    assert np.percentile(at_middle, 99) <= 50_000
    # Four of the echoes are neither lost nor late. The error is largest if three of these four are
    # neighbours.
    assert at_middle.max() <= 60_000
    # The error at the time of the last echo is larger if all four are much earlier.
    assert np.percentile(at_last, 95) <= 50_000
