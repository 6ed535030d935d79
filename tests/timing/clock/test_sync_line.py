"""Edges are matched to the nearest instant of the reference, if the match is unambiguous."""

from __future__ import annotations

import pytest

from jointfit_daemon.timing.clock._sync_line import Edge, SyncLine

MS = 1_000_000


def line(*instants_ms: float) -> SyncLine:
    found = SyncLine()
    for at in instants_ms:
        found.instant(Edge(round(at * MS), round(at)))
    return found


@pytest.mark.parametrize(
    ("edge_ms", "pairs"),
    [
        (100.0, [(7, 100)]),
        (103.5, [(7, 100)]),  # 35 % of the interval of 10 ms
        (103.6, []),
        (106.4, []),
        (106.5, [(7, 110)]),
        (110.0, [(7, 110)]),
    ],
)
def test_an_edge_is_matched_within_a_share_of_the_interval(
    edge_ms: float, pairs: list[tuple[int, int]]
) -> None:
    sync = line(90, 100, 110, 120)
    sync.pulse("S1", Edge(round(edge_ms * MS), 7))
    assert sync.match_edges("S1") == pairs
    assert sync.unmatched == 1 - len(pairs)
    assert sync.match_edges("S1") == []


@pytest.mark.parametrize(("off_ms", "matched"), [(20.0, True), (20.1, False), (-20.0, True)])
def test_an_edge_is_never_matched_farther_than_20_ms(off_ms: float, matched: bool) -> None:
    sync = line(0, 1000, 2000)
    sync.pulse("S1", Edge(round((1000 + off_ms) * MS), 7))
    assert sync.match_edges("S1") == ([(7, 1000)] if matched else [])


def test_an_edge_waits_for_the_instant_after_it() -> None:
    sync = line(100)
    sync.pulse("S1", Edge(101 * MS, 7))
    assert sync.match_edges("S1") == []
    assert sync.unmatched == 0
    sync.instant(Edge(110 * MS, 110))
    assert sync.match_edges("S1") == [(7, 100)]
    assert sync.match_edges("S2") == []


def test_an_edge_before_every_instant_has_no_match() -> None:
    sync = line(100, 110)
    for at in (100, 99):
        sync.pulse("S1", Edge(at * MS, at))
    assert sync.match_edges("S1") == []
    assert sync.unmatched == 2


def test_a_repeated_instant_is_ignored_and_a_reference_that_restarts_begins_anew() -> None:
    sync = line(100, 110, 90.1, 120)
    sync.pulse("S1", Edge(111 * MS, 7))
    assert sync.match_edges("S1") == [(7, 110)]
    sync = line(100, 110, 90, 100, 110)
    sync.pulse("S1", Edge(91 * MS, 7))
    assert sync.match_edges("S1") == [(7, 90)]


def test_the_oldest_of_65_waiting_edges_is_dropped() -> None:
    sync = SyncLine()
    for number in range(65):
        sync.pulse("S1", Edge((100 + 10 * number) * MS, number))
    assert sync.unmatched == 1
    for number in range(70):
        sync.instant(Edge((100 + 10 * number) * MS - 1, number))
    assert sync.match_edges("S1") == [(number, number) for number in range(1, 65)]


def test_the_older_half_of_513_instants_is_dropped() -> None:
    sync = line(*range(0, 5130, 10))
    for at in (2550, 2561):
        sync.pulse("S1", Edge(at * MS, at))
    assert sync.match_edges("S1") == [(2561, 2560)]
    assert sync.unmatched == 1
