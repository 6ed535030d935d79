"""Stream of the aligner: longest extrapolation, and wait for a stream without samples."""

from __future__ import annotations

from jointfit_daemon.timing.alignment._stream import PATIENCE, REACH, Stream

PERIOD_NS = 10_000_000
UNTURNED = (1.0, 0.0, 0.0, 0.0)


def test_the_last_sample_reaches_exactly_as_far_as_documented() -> None:
    reach_ns = round(REACH * PERIOD_NS)
    for beyond_ns in (0, 1):
        stream = Stream(PERIOD_NS)
        stream.push(0, 0, UNTURNED, synced=True, epoch=0, passed_ns=None)
        stream.push(PERIOD_NS, PERIOD_NS, UNTURNED, synced=True, epoch=0, passed_ns=None)
        found = stream.at(PERIOD_NS + reach_ns + beyond_ns)
        assert (found is None) is (beyond_ns == 1)


def test_a_frame_waits_for_a_stream_without_samples_for_its_patience() -> None:
    t_ns = 7_000_000_000
    assert Stream(PERIOD_NS).latest_wait_ns(t_ns) == t_ns + round(PATIENCE * PERIOD_NS)
