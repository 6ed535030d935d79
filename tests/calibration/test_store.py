"""The store: whole versions or none, nothing overwritten, damage named and stepped over."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.calibration.result import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
)
from jointfit_daemon.calibration.store import CalibrationStore, CalibrationUnreadable

if TYPE_CHECKING:
    from pathlib import Path

PLAIN = Calibration(
    method="mean",
    joints=("hip", "knee"),
    segments=("thigh",),
    chain_sensors=(("S1",),),
    sensor={"S1": SensorCalibration((1.0, 0.0, 0.0, 0.0), (0.6, 0.0, 0.8, 0.0), 7, 0.1 + 0.2)},
    segment={"thigh": SegmentCalibration((1.0, 0.0, 0.0, 0.0), 0.42, None)},
    joint={
        "hip": JointCalibration((0.0, 0.1, 0.9), 1 / 3, "fit"),
        "knee": JointCalibration(None, None, "unknown"),
    },
)


def numbered(created: str) -> Calibration:
    return replace(PLAIN, created_utc=created)


def test_versions_count_up_and_come_back_exactly(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "subject-07")
    assert store.latest() is None
    assert [store.save(numbered(c)) for c in "ab"] == [1, 2]
    assert store.load(1) == numbered("a")
    latest = store.latest()
    assert latest is not None
    assert (latest.version, latest.notes) == (2, ())
    assert latest.calibration == numbered("b")
    assert sorted(p.name for p in (tmp_path / "subject-07").iterdir()) == ["0001.json", "0002.json"]


@pytest.mark.parametrize("damage", [b"", b"{", b"null", b'{"schema": 1}', b"\xff\xfe\x00"])
def test_a_damaged_version_is_named_and_the_one_before_is_used(
    tmp_path: Path, damage: bytes
) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(numbered("good"))
    store.save(numbered("bad"))
    store.path(2).write_bytes(damage)
    with pytest.raises(CalibrationUnreadable, match=r"0002\.json"):
        store.load(2)
    latest = store.latest()
    assert latest is not None
    assert latest.version == 1
    assert "0002.json" in latest.notes[0]
    assert store.save(numbered("next")) == 3
    assert store.path(2).read_bytes() == damage


def test_nothing_readable_is_no_silence(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(PLAIN)
    store.path(1).write_text("x", encoding="utf-8")
    with pytest.raises(CalibrationUnreadable, match=r"0001\.json"):
        store.latest()
    with pytest.raises(CalibrationUnreadable, match="no such version; stored: 1"):
        store.load(9)


@pytest.mark.parametrize("step", ["fsync", "link"])
def test_a_stop_at_any_step_leaves_the_version_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(numbered("before"))

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(os, step, stop)
        with pytest.raises(KeyboardInterrupt):
            store.save(numbered("never"))
    assert store.versions() == [1]
    latest = store.latest()
    assert latest is not None
    assert latest.calibration.created_utc == "before"
    assert store.save(numbered("after")) == 2


def test_a_version_of_another_process_is_never_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = CalibrationStore(tmp_path, "s"), CalibrationStore(tmp_path, "s")
    ours.save(numbered("first"))
    seen = ours.versions()
    theirs.save(numbered("theirs"))
    monkeypatch.setattr(CalibrationStore, "versions", lambda _: seen)
    assert ours.save(numbered("ours")) == 3
    assert ours.load(2).created_utc == "theirs"


def test_a_file_system_without_links_still_stores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unable(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", unable)
    store = CalibrationStore(tmp_path, "s")
    assert [store.save(PLAIN), store.save(PLAIN)] == [1, 2]
    assert store.load(2) == PLAIN


@pytest.mark.parametrize("name", ["", "..", "a/b", "-x", "ä"])
def test_a_name_that_leaves_the_directory_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="letters"):
        CalibrationStore(tmp_path, name)
