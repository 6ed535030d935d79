"""Log lines are limited in rate, and omitted lines are counted."""

from __future__ import annotations

import io
import logging

from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.outputs.log import RateLimitedHandler
from jointfit_daemon.outputs.log._rate_limit import BURST, RATE_HZ
from jointfit_daemon.outputs.token_bucket import TokenBucket


def said(handler: RateLimitedHandler, count: int, level: int = logging.WARNING) -> None:
    for number in range(count):
        handler.handle(logging.LogRecord("a", level, "", 0, f"line {number}", None, None))


@given(st.lists(st.floats(0, 3), min_size=1, max_size=300))
def test_rate_never_exceeds_the_limit(gaps_s: list[float]) -> None:
    allowance, now_s, taken = TokenBucket(RATE_HZ, BURST, 0.0), 0.0, 0
    for gap_s in gaps_s:
        now_s += gap_s
        taken += allowance.take(now_s)
    assert taken <= BURST + RATE_HZ * now_s + 1e-6


def test_omitted_lines_are_counted() -> None:
    now_s = [0.0]
    stream = io.StringIO()
    handler = RateLimitedHandler(stream, lambda: now_s[0])
    said(handler, 1000)
    assert stream.getvalue().count("\n") == BURST
    now_s[0] = 1.0
    said(handler, 1)
    lines = stream.getvalue().splitlines()
    assert lines[-2] == "950 lines omitted: more than 5 lines per second"
    assert lines[-1] == "line 0"


def test_errors_are_exempt_from_the_rate_limit() -> None:
    stream = io.StringIO()
    said(RateLimitedHandler(stream), 200, logging.ERROR)
    assert stream.getvalue().count("line ") == 200


def test_few_lines_are_all_written() -> None:
    stream = io.StringIO()
    said(RateLimitedHandler(stream), 20)
    assert stream.getvalue().count("\n") == 20
