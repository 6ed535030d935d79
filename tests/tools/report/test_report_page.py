"""The page of a session states all results, runs no code, and is accessible in Chromium."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typing_extensions import override

from jointfit_daemon.session_data import JointSeries, SessionData, TimelineEvent
from jointfit_daemon.tools.report.page import render_report
from jointfit_simulators.body import Step
from tests.session_analysis.simulated_session import simulated_session
from tests.tools.dashboard.browser import SIZES, chromium, opened

if TYPE_CHECKING:
    from pathlib import Path

STEPS = (Step("stand", 5.0), Step("walk", 25.0), Step("squat", 10.0))
SECTIONS = (
    "Joint angles", "Gait cycles", "Range of motion", "Sensors against cameras",
    "Recorded data", "Timing", "Calibration", "Faults and events",
)  # fmt: skip
VOID = {"meta", "line", "path", "rect", "br"}


@pytest.fixture(scope="module")
def session() -> SessionData:
    return simulated_session(STEPS, seed=2, gap_s=(14.0, 16.2))


@pytest.fixture(scope="module")
def page(session: SessionData) -> str:
    return render_report(session)


class TagBalance(HTMLParser):
    """Collects headings, and fails on a tag that is not closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []
        self.tags: set[str] = set()

    @override
    def handle_starttag(self, tag: str, _: object) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)

    @override
    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    @override
    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def parsed(text: str) -> TagBalance:
    found = TagBalance()
    found.feed(text)
    assert found.open == []
    return found


def words(text: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text))


def test_page_has_every_section_once(page: str) -> None:
    assert tuple(parsed(page).headings) == SECTIONS


def test_page_states_who_was_recorded_when_and_how_long(page: str) -> None:
    for text in ("bench-1", "P02", "21 November 2026, 08:34:20 UTC", "40.0 s", "version 3"):
        assert text in words(page)


def test_page_states_gait_loss_errors_and_faults(page: str) -> None:
    text = words(page)
    for part in ("stride 1.10 s", "1, longest 2.2 s", "Salarian et al. 2004", "1.9°",
                 "no data: check its cable", "9.8 ms", "12.4", "Faults 1 see"):  # fmt: skip
        assert part in text, part


def test_page_refers_to_nothing_outside_and_runs_nothing(page: str) -> None:
    assert parsed(page).tags.isdisjoint({"script", "link", "img", "iframe", "object", "use"})
    assert not re.search(r"https?://|url\(|@import|\son\w+=|\sstyle=", page)
    assert "default-src 'none'" in page


def test_names_and_texts_of_a_recording_are_escaped(session: SessionData) -> None:
    hostile = '<svg onload="x">"><script>alert(1)</script>'
    changed = replace(
        session,
        name=hostile,
        joints=(replace(session.joints[0], name=hostile),),
        events=(TimelineEvent(0.0, "mark", hostile, hostile, {"level": hostile}),),
        sensors=tuple(replace(s, id=s.id + hostile, segment=hostile) for s in session.sensors),
        description={"rig": hostile, "subject": hostile},
    )
    text = render_report(changed)
    assert "<script" not in text
    assert "<svg onload" not in text
    assert "script" not in parsed(text).tags


def test_equal_sessions_give_equal_bytes(session: SessionData, page: str) -> None:
    assert render_report(simulated_session(STEPS, seed=2, gap_s=(14.0, 16.2))) == page
    assert render_report(replace(session, name="other", description={})) != page


POOR = (
    SessionData("empty"),
    SessionData(
        "nothing known",
        joints=(
            JointSeries(
                "knee", np.arange(3.0), {"flexion": np.full(3, np.nan)},
                {"flexion": np.full(3, np.nan)},
            ),
        ),
    ),
    SessionData("one row", joints=(JointSeries("knee", np.zeros(1), {"flexion": np.ones(1)}),)),
)  # fmt: skip


@pytest.mark.parametrize("poor", POOR, ids=lambda session: session.name)
def test_poor_sessions_are_reported_with_reasons(poor: SessionData) -> None:
    assert tuple(parsed(render_report(poor)).headings) == SECTIONS


def test_session_without_cameras_has_no_reference(session: SessionData) -> None:
    alone = replace(session, markers=None, optical_joints=(), optical_segments=())
    text = words(render_report(alone))
    assert "There is no reference" in text
    assert "mean from the cameras" not in text


def test_long_session_stays_small_and_shows_its_peak() -> None:
    t_s = np.arange(0.0, 3600.0, 0.01)
    angle = np.sin(t_s)
    angle[200_000] = np.radians(80.0)  # only one sample has this value
    names = ("flexion", "adduction", "rotation")
    joint = JointSeries("knee", t_s, dict.fromkeys(names, angle), {"flexion": 0.1 + 0.0 * t_s})
    text = render_report(SessionData("long", joints=(joint,)))
    assert len(text) < 600_000
    assert "−57.3° to 80.0°" in text


def test_curves_begin_at_the_end_of_a_calibration() -> None:
    t_s = np.arange(0.0, 100.0, 0.01)
    angle = np.where(t_s < 60.0, np.nan, np.sin(t_s))
    joint = JointSeries("knee", t_s, {"flexion": angle}, {})
    text = render_report(SessionData("calibrated", joints=(joint,)))
    curves = text[text.index("Joint angles</h2>") : text.index("Detail of 10 s")]
    assert "No angle is known before 60 s" in curves
    ticks = [int(tick) for tick in re.findall(r">(\d+)(?: s)?</text>", curves)]
    assert 70 in ticks
    assert 15 not in ticks


@pytest.mark.system
@pytest.mark.experiment
@pytest.mark.timeout(150)
async def test_page_is_accessible_and_fits_phone_tablet_and_desktop(
    page: str, tmp_path: Path
) -> None:
    path = tmp_path / "report.html"
    path.write_text(page, "utf-8")
    async with chromium() as browser:
        for scheme in ("light", "dark"):
            for size in SIZES:
                async with opened(browser, path.as_uri(), size=size, scheme=scheme) as shown:
                    await shown.picture(f"report-{size}-{scheme}")
                    overflow = "document.documentElement.scrollWidth - innerWidth"
                    assert await shown.page.evaluate(overflow) <= 0, size
                    assert await shown.accessibility_faults() == [], (size, scheme)
                    assert shown.foreign == []
                    assert shown.errors == []
