"""Kernel stamps of CAN frames on the host's monotonic clock."""

from __future__ import annotations

import pytest

from jointfit_drivers.ports._kernel_stamps import KernelStamps
from jointfit_protocols.can import frame_bits

S = 1_000_000_000


class Clocks:
    def __init__(self) -> None:
        self.monotonic, self.offset = 100 * S, 1_700_000_000 * S

    def monotonic_ns(self) -> int:
        return self.monotonic

    def unix_ns(self) -> int:
        return self.monotonic + self.offset


def stamped(clocks: Clocks, stamps: KernelStamps, ago_ns: int, offset: int | None = None) -> int:
    """Return the time from the end of a frame until now, ns, as computed from its kernel stamp.

    The true time is `ago_ns`. At the time of the stamp, the wall clock minus the monotonic clock is
    `offset`, or its current value if `offset` is None.
    """
    unix = clocks.monotonic - ago_ns + (clocks.offset if offset is None else offset)
    start = stamps.start_ns(unix / S, 8, extended=False)
    return clocks.monotonic - start - frame_bits(8, extended=False) * 1000


def test_a_kernel_stamp_becomes_the_monotonic_start_of_the_frame() -> None:
    clocks = Clocks()
    stamps = KernelStamps(1_000_000, clocks.monotonic_ns, clocks.unix_ns)
    stamps.pair()
    assert stamped(clocks, stamps, 5_000_000) == pytest.approx(5_000_000, abs=300)


@pytest.mark.parametrize("step_s", [-3600, 3600, 0.01])
def test_a_stepped_wall_clock_moves_no_frame(step_s: float) -> None:
    clocks = Clocks()
    stamps = KernelStamps(1_000_000, clocks.monotonic_ns, clocks.unix_ns)
    stamps.pair()
    before = clocks.offset
    clocks.offset += round(step_s * S)
    clocks.monotonic += 1_000_000
    stamps.pair()
    if abs(step_s) > 2:  # a small step looks like a delay of the frame
        assert stamped(clocks, stamps, 500_000, before) == pytest.approx(500_000, abs=300)
    assert stamped(clocks, stamps, 200_000) == pytest.approx(200_000, abs=300)
    assert stamps.replaced == 0


def test_an_absurd_stamp_is_replaced_by_now_and_counted() -> None:
    clocks = Clocks()
    stamps = KernelStamps(1_000_000, clocks.monotonic_ns, clocks.unix_ns)
    stamps.pair()
    assert stamped(clocks, stamps, 500 * S) == 0
    assert stamps.replaced == 1
