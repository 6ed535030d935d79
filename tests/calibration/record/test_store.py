"""The store writes only complete versions, overwrites none, and reports damaged versions."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.calibration.record import CalibrationFileError, CalibrationStore
from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.calibration.record._store import checksum
from jointfit_daemon.limb_model import (
    CalibratedCenter,
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
    SensorLink,
)
from tests.calibration import calibrated_subject

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
        "hip": JointCalibration(
            (0.0, 0.1, 0.9),
            1 / 3,
            "fit",
            rotation=CalibratedCenter(
                (0.0, 0.1, 1 / 7), ((1e-6, 0.0, 0.0),) * 3, ((0.6, 0.0, 0.8),)
            ),
        ),
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
    with pytest.raises(CalibrationFileError, match=r"0002\.json"):
        store.load(2)
    latest = store.latest()
    assert latest is not None
    assert latest.version == 1
    assert "0002.json" in latest.notes[0]
    assert latest.notes[0].endswith("renamed to 0002.json.bad; version 1 is used")
    assert store.save(numbered("next")) == 3
    assert store.path(2).with_name("0002.json.bad").read_bytes() == damage
    again = store.latest()
    assert again is not None
    assert (again.version, again.notes) == (3, ())


def test_store_without_readable_version_reports_it(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(PLAIN)
    store.path(1).write_text("x", encoding="utf-8")
    with pytest.raises(CalibrationFileError, match=r"0001\.json"):
        store.latest()
    with pytest.raises(CalibrationFileError, match="no such version; stored: none"):
        store.load(9)
    assert store.latest() is None


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


def test_version_written_by_another_process_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = CalibrationStore(tmp_path, "s"), CalibrationStore(tmp_path, "s")
    ours.save(numbered("first"))
    seen = ours.versions()
    theirs.save(numbered("theirs"))
    monkeypatch.setattr(CalibrationStore, "versions", lambda _: seen)
    assert ours.save(numbered("ours")) == 3
    assert ours.load(2).created_utc == "theirs"


def test_last_version_number_is_followed_by_no_other(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(numbered("first"))
    (tmp_path / "s" / "0001.json").rename(tmp_path / "s" / "999999998.json")
    assert store.save(numbered("last")) == 999_999_999
    with pytest.raises(OSError, match="version 999999999 is the last possible number: move"):
        store.save(numbered("beyond"))
    assert store.versions() == [999_999_998, 999_999_999]
    latest = store.latest()
    assert latest is not None
    assert latest.calibration.created_utc == "last"


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


def stored_table(folder: Path) -> dict[str, Any]:
    """Return the parsed file of a limb with online learning, as the store writes it."""
    link = SensorLink(
        "S1",
        "S2",
        "pair",
        ("S3",),
        ((0.0,) * 10,) * 3,
        (-1.0,) * 10,
        (1.0,) * 10,
        0.01,
        0.1,
        ((0.02,) * 10,) * 10,
    )
    calibration = replace(
        calibrated_subject.calibration(), links=(link,), correlations={"knee": 0.5}
    )
    store = CalibrationStore(folder, "s")
    path = store.path(store.save(calibration))
    table: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    assert store.load(1) == calibration
    return table


Change = Callable[[dict[str, Any]], Any]


def first(table: dict[str, Any]) -> Any:
    return table[next(iter(table))]


def model(content: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = first(first(content["segment"])["models"])
    return found


WRONG: dict[str, Change] = {
    "method": lambda c: c.update(method="mood"),
    "joints text": lambda c: c.update(joints="hip"),
    "segments number": lambda c: c.update(segments=3),
    "sensor missing": lambda c: c["sensor"].popitem(),
    "sensor list": lambda c: c.update(sensor=[]),
    "segment missing": lambda c: c["segment"].popitem(),
    "joint missing": lambda c: c["joint"].popitem(),
    "zero quaternion": lambda c: first(c["sensor"]).update(q_sensor_segment=[0, 0, 0, 0]),
    "static zero": lambda c: first(c["segment"]).update(q_static=[0.0, 0.0, 0.0, 0.0]),
    "quaternion of three": lambda c: first(c["sensor"]).update(q_optical_world=[1, 0, 0]),
    "lag text": lambda c: first(c["sensor"]).update(lag_ns="soon"),
    "lag year": lambda c: first(c["sensor"]).update(lag_ns=10**17),
    "length text": lambda c: first(c["segment"]).update(length="long"),
    "length negative": lambda c: first(c["segment"]).update(length=-0.4),
    "center of two": lambda c: first(c["joint"]).update(center=[0.0, 0.1]),
    "sd list": lambda c: first(c["joint"]).update(sd=[1.0]),
    "flags numbers": lambda c: c.update(flags=[1, 2]),
    "digest list": lambda c: c.update(digest=[]),
    "memory": lambda c: c.update(memory="!"),
    "link sensor": lambda c: c["links"][0].update(a="S9"),
    "link weights": lambda c: c["links"][0].update(weights=[[0.0]]),
    "link low": lambda c: c["links"][0].update(low=["a"] * 10),
    "model kind": lambda c: model(c).update(kind="magic"),
    "model residual": lambda c: model(c).update(residual_sd=None),
    "model weights": lambda c: model(c).update(weights=["a"]),
    "quality number": lambda c: c.update(quality={"static": 3}),
    "quality lag": lambda c: c.update(quality={"lag": {"S1": []}}),
    "quality lag sigma": lambda c: c.update(quality={"lag": {"S1": {"sigma_ns": "small"}}}),
    "quality holdout": lambda c: c.update(quality={"holdout": {"segments": {"thigh": 3}}}),
    "quality rounds": lambda c: c.update(quality={"online": {"rounds": "two"}}),
    "correlation": lambda c: c.update(correlations={"nose": 0.5}),
    "schema": lambda c: c.update(schema=True),
    "deep": lambda c: c.update(quality=nested(40)),
}


def nested(levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = {"a": value}
    return value


def test_a_rigid_body_may_have_a_template_without_markers(tmp_path: Path) -> None:
    content = stored_table(tmp_path)["calibration"]
    first(content["clusters"]).update(markers=[], body="Thigh")
    assert content_faults(Calibration.from_dict(content)) == []


@pytest.mark.parametrize("name", WRONG)
def test_wrong_content_is_set_aside_even_with_a_matching_checksum(
    tmp_path: Path, name: str
) -> None:
    table = stored_table(tmp_path)
    store = CalibrationStore(tmp_path, "s")
    content = table["calibration"]
    WRONG[name](content)
    damaged = {"sha256": checksum(content), "calibration": content}
    store.save(PLAIN)
    store.path(2).write_text(json.dumps(damaged), encoding="utf-8")
    latest = store.latest()
    assert latest is not None
    assert latest.version == 1
    assert "renamed to 0002.json.bad" in latest.notes[0]


def test_manually_edited_calibration_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    path = store.path(store.save(PLAIN))
    path.write_text(path.read_text().replace("0.42", "0.43"))
    with pytest.raises(CalibrationFileError, match=r"checksum differs.*edited.*calibrate again"):
        store.load(1)


def test_a_file_from_before_checksums_is_read(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    path = store.path(store.save(PLAIN))
    path.write_text(json.dumps(PLAIN.to_dict()))
    assert store.load(1) == PLAIN


def test_a_file_that_cannot_be_read_is_not_set_aside(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.save(PLAIN)
    store.path(2).mkdir()
    latest = store.latest()
    assert latest is not None
    assert latest.version == 1
    assert "is a directory" in latest.notes[0]
    assert store.path(2).is_dir()


WRITTEN = json.dumps(
    {"sha256": checksum(PLAIN.to_dict()), "calibration": PLAIN.to_dict()}, indent=1
).encode()


@given(
    at=st.integers(0, len(WRITTEN) - 1),
    cut=st.integers(0, 3),
    inserted=st.binary(max_size=3) | st.sampled_from([b"[" * 5000, b"1" * 5000, b'"', b"null"]),
)
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_mutated_file_is_refused_or_has_the_same_content(
    tmp_path: Path, at: int, cut: int, inserted: bytes
) -> None:
    store = CalibrationStore(tmp_path, "s")
    store.path(1).parent.mkdir(exist_ok=True)
    store.path(1).write_bytes(WRITTEN[:at] + inserted + WRITTEN[at + cut :])
    try:
        found = store.load(1)
    except CalibrationFileError:
        return
    assert found == PLAIN


def test_no_flipped_bit_changes_the_content(tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "s")
    path = store.path(store.save(PLAIN))
    written = path.read_bytes()
    for at in range(0, 8 * len(written), 11):
        flipped = bytearray(written)
        flipped[at // 8] ^= 1 << at % 8
        path.write_bytes(flipped)
        try:
            found = store.load(1)
        except CalibrationFileError:
            continue
        assert found == PLAIN


def test_a_link_stored_without_uncertainty_is_read(tmp_path: Path) -> None:
    table = stored_table(tmp_path)
    link = dict(table["calibration"]["links"][0])
    del link["uncertainty"]
    assert SensorLink.from_dict(link).uncertainty == ()
