"""Written sessions are read back unchanged, as far as the format contains their content."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.files.sessions import read_session, write_session
from jointfit_daemon.session_data import FrameSeries, SessionData
from tests.files.sessions.session_strategy import (
    assert_same_group,
    assert_same_series,
    assert_same_values,
    known_rows,
    session_data,
    time_axes,
)

FEW = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
WHOLE = {"csv": 1e-8, "parquet": 1e-12, "xdf": 1e-12, "bids-motion": 1e-8}
"""Formats that contain all kinds of content, with their relative precision."""
GROUPS = ("sensors", "segments", "joints", "optical_segments", "optical_joints")


def there_and_back(session: SessionData, to: str, *, file: int = 0) -> SessionData:
    with tempfile.TemporaryDirectory() as folder:
        written = write_session(session, Path(folder), to)
        path = written.files[file]
        return read_session(path if to != "bids-motion" else Path(folder) / f"{session.name}_bids")


@pytest.mark.parametrize("to", WHOLE)
@FEW
@given(session=session_data())
def test_a_whole_session_is_read_back_unchanged(to: str, session: SessionData) -> None:
    if to == "parquet":
        pytest.importorskip("pyarrow")
    found = there_and_back(session, to)
    assert found.name == session.name
    assert found.start_unix_ns == session.start_unix_ns
    assert session.description.items() <= found.description.items()
    for group in GROUPS:
        assert_same_group(getattr(found, group), getattr(session, group), WHOLE[to])
    assert_same_series(found.markers, session.markers, WHOLE[to])
    assert [(e.kind, e.id, e.data) for e in found.events] == [
        (e.kind, e.id, e.data) for e in session.events
    ]
    texts = [" ".join(e.text.split()) for e in found.events]
    assert texts == [" ".join(e.text.split()) for e in session.events]
    np.testing.assert_allclose(
        [e.t_s for e in found.events], [e.t_s for e in session.events], atol=1e-9
    )


@FEW
@given(session=session_data())
def test_session_without_start_time_keeps_its_time_stamps_in_xdf(session: SessionData) -> None:
    timeless = replace(session, start_unix_ns=None)
    found = there_and_back(timeless, "xdf")
    assert found.start_unix_ns is None
    for group in GROUPS:
        assert_same_group(getattr(found, group), getattr(timeless, group), WHOLE["xdf"])


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_mode_and_flags_of_every_frame_come_back(to: str) -> None:
    if to == "parquet":
        pytest.importorskip("pyarrow")
    frames = FrameSeries(
        np.array([0.01, 0.02, 0.03]),
        ("imu+mocap", "imu", "imu"),
        ("", "held:thigh untrained:shank", ""),
    )
    found = there_and_back(SessionData("walk", frames=frames), to).frames
    assert found is not None
    np.testing.assert_allclose(found.t_s, frames.t_s, atol=1e-9)
    assert (found.modes, found.flags) == (frames.modes, frames.flags)


@pytest.mark.parametrize(("to", "precision"), [("trc", 1e-7), ("c3d", 2e-7)])
@FEW
@given(session=session_data())
def test_markers_are_read_back_unchanged(to: str, precision: float, session: SessionData) -> None:
    if to == "c3d":
        pytest.importorskip("c3d")
    found = there_and_back(session, to)
    assert_same_series(found.markers, session.markers, precision, time_s=1e-4)
    if to == "c3d":
        assert found.start_unix_ns == session.start_unix_ns
        assert [(e.kind, e.id) for e in found.events] == [(e.kind, e.id) for e in session.events]
        assert [e.text for e in found.events] == [e.text for e in session.events]
        np.testing.assert_allclose(
            [e.t_s for e in found.events], [e.t_s for e in session.events], atol=1e-5
        )


@FEW
@given(st.data())
def test_orientations_are_read_back_with_their_gaps(data: st.DataObject) -> None:
    session = data.draw(session_data(axis=data.draw(time_axes())))
    for group in ("sensors", "segments", "optical_segments"):
        with tempfile.TemporaryDirectory() as folder:
            files = sorted(write_session(session, Path(folder), "sto").files)
            found = read_session({path.stem: path for path in files}[f"walk 1_{group}"])
        assert found.start_unix_ns == session.start_unix_ns
        back = {getattr(s, "id", "") or s.name: s for s in getattr(found, group)}
        for there in getattr(session, group):
            name = getattr(there, "id", "") or there.name
            assert_same_values(
                (back[name].t_s, back[name].orientation),
                (there.t_s, there.orientation),
                1e-7,
                1e-4,
            )


@FEW
@given(st.data())
def test_joints_are_read_back_if_all_values_are_known(data: st.DataObject) -> None:
    session = data.draw(session_data(axis=data.draw(time_axes()), gaps=False))
    for group, file in (("joints", 0), ("optical_joints", 1)):
        with tempfile.TemporaryDirectory() as folder:
            files = sorted(write_session(session, Path(folder), "mot").files)
            found = read_session(files[file])
        assert found.start_unix_ns == session.start_unix_ns
        assert_same_group(getattr(found, group), getattr(session, group), 1e-7, time_s=1e-4)


def test_known_rows_leave_out_unknown_ones_only() -> None:
    values = np.array([[1.0, 2.0], [np.nan, np.nan], [np.nan, 3.0]])
    assert known_rows(np.arange(3.0), values)[0].tolist() == [0.0, 2.0]
