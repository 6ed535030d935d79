"""Verification: equal bytes pass, and each kind of difference is named with time and key."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.recording import (
    PROGRAM,
    Recorder,
    Recording,
    _recorder,
    _session_writer,
)
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import Configured, SourceOpened, UnixOffset
from jointfit_daemon.reprocessing import _verification, verify_recording
from tests.pipeline.core_feed import BEGIN_NS, Bench
from tests.reprocessing.recorded_run import (
    UNIX_NS,
    RecordedRun,
    RecordingBench,
    at,
    record_run,
    rig_table,
    samples,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output


def test_run_with_calibration_reconnection_and_reload_is_equal_byte_for_byte(
    run: RecordedRun,
) -> None:
    found = verify_recording(run.path)
    assert found.passed
    assert found.compared["output/state"] == run.states
    assert {"output/notice", "output/calibration", "output/device"} <= found.compared.keys()
    assert "outputs are equal, byte for byte" in found.lines()[-1]


def test_changed_number_is_named_with_its_time_and_key(
    run: RecordedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = Core.feed

    def other(core: Any, event: Event) -> list[Output]:
        return [
            output._replace(flags=("slipped:S1",))
            if isinstance(output, LimbState) and output.seq == 300
            else output
            for output in feed(core, event)
        ]

    monkeypatch.setattr(Core, "feed", other)
    found = verify_recording(run.path)
    assert not found.passed
    assert found.difference is not None
    assert found.difference.key == "flags[0]"
    assert found.difference.t_s == pytest.approx(3.0, abs=0.1)
    assert found.difference.replayed == '"slipped:S1"'
    assert "first difference at 2.99" in found.lines()[0]


def test_output_that_only_the_replay_has_is_a_difference(
    run: RecordedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = Core.feed

    def twice(core: Any, event: Event) -> list[Output]:
        outputs = feed(core, event)
        return [*outputs, *outputs]

    monkeypatch.setattr(Core, "feed", twice)
    found = verify_recording(run.path)
    assert found.difference is not None
    assert (found.difference.key, found.difference.recorded) == ("", "none")


def test_outputs_after_a_gap_are_not_compared(
    run: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_recorder, "PENDING_BYTES", 1_500_000)  # as if the disk were slow
    record_run(tmp_path)
    found = verify_recording(tmp_path)
    assert found.passed
    assert found.gaps
    assert found.until_s is not None
    assert 0.5 < found.until_s < 4.5
    assert 0 < found.compared["output/state"] < run.states
    text = "\n".join(found.lines())
    assert "the recording has a gap at" in text
    assert "cannot be compared" in text


def test_a_recording_of_another_version_is_named_with_both_versions(
    run: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "version" not in " ".join(verify_recording(run.path).lines())

    monkeypatch.setattr(_session_writer, "SOFTWARE", "jointfitd 0.0.9, mcap 1")
    record_run(tmp_path)
    assert verify_recording(tmp_path).lines()[0] == (
        f"the recording was made by jointfitd 0.0.9 and replayed by {PROGRAM}: results of another "
        "version can differ"
    )


@pytest.mark.parametrize(("turned_deg", "agrees"), [(0.0, True), (3.0, False)])
def test_recording_that_began_later_is_compared_with_a_tolerance(
    turned_deg: float,
    agrees: bool,
    run: RecordedRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_verification, "WARM_UP_S", 1.0)
    monkeypatch.setattr(Recording, "began_with_daemon", property(lambda _: False))
    rig = parse_rig(rig_table())
    opened = [SourceOpened(BEGIN_NS, source.id) for source in rig.sources]
    before = Bench()
    before.feed([Configured(BEGIN_NS, rig, run.calibration, 1), UnixOffset(BEGIN_NS, UNIX_NS)])
    before.feed([*opened, *samples(0, 250)])

    # the recording begins with the configuration, and the core continues
    late = RecordingBench(core=before.core, recorder=Recorder(tmp_path, "r"))
    worn = run.calibration
    if turned_deg:
        q = (np.cos(np.radians(turned_deg) / 2), np.sin(np.radians(turned_deg) / 2), 0.0, 0.0)
        sensor = {
            name: replace(item, q_sensor_segment=multiply_one(item.q_sensor_segment, q))
            for name, item in worn.sensor.items()
        }
        worn = replace(worn, sensor=sensor)
    t_ns = at(250)
    start: list[Event] = [Configured(t_ns, rig, worn, 1), UnixOffset(t_ns, UNIX_NS), *opened]
    for event in start:
        late.recorder.event(event)
    late.feed(samples(250, 500))
    late.recorder.close()

    found = verify_recording(tmp_path)
    assert found.tolerant is not None
    assert found.tolerant.compared > 200
    assert found.passed is agrees
    assert "began after the start of the daemon" in found.lines()[0]


def test_recording_without_outputs_does_not_pass(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "r")
    recorder.event(Configured(BEGIN_NS, parse_rig(rig_table()), None))
    recorder.close()
    assert not verify_recording(tmp_path).passed


def test_the_angle_between_nearly_equal_orientations_has_full_precision() -> None:
    angle, t_s = 1e-6, np.arange(3.0)
    turned = np.tile([np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0], (3, 1))
    same = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    same[1] = np.nan
    errors = _verification._orientation_errors({"thigh": (t_s, same)}, {"thigh": (t_s, turned)})
    np.testing.assert_allclose(errors, [angle, angle], rtol=1e-9)
