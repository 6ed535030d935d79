"""A receiver of the Lab Streaming Layer gets every frame with its instant and its units."""

from __future__ import annotations

import math
import sys
import time
from typing import Any, NamedTuple

import numpy as np
import pytest

from jointfit_daemon.config import LslSettings
from jointfit_daemon.model import (
    FusionMode,
    JointAngles,
    JointState,
    LimbState,
    SegmentState,
    SyncState,
)
from jointfit_daemon.outputs.lsl import LslError, LslOutlet
from tests.lsl_fixture import receive

RATE_HZ = 100.0


def frame(number: int, t_ns: int, *, known: bool = True) -> LimbState:
    q = (1.0, 0.0, 0.0, 0.0) if known else None
    angles = JointAngles(0.01 * number, 0.2, 0.3) if known else None
    return LimbState(
        number,
        t_ns,
        t_ns,
        FusionMode.IMU,
        SyncState.LOCKED,
        (),
        (SegmentState("thigh", q, 0.02 if known else None, ("S1",)),),
        (JointState("knee", (0.1, 0.2, 0.3) if known else None, None, angles, None, 0.04),),
    )


class Received(NamedTuple):
    """Received data without objects of the library, so that the library's sockets are closed."""

    rate_hz: float
    labels: list[str]
    units: list[str]
    joints: list[list[float]]
    stamps: list[float]
    segments: list[float]
    correction_s: float


def send_and_receive(lsl: Any, instants_ns: list[int]) -> Received:
    outlet = LslOutlet(LslSettings(name="tested rig"), "bench-1", RATE_HZ)
    outlet.start()
    outlet.output(frame(0, time.monotonic_ns()))  # opens the streams
    joints, segments = receive(lsl, "tested rig joints"), receive(lsl, "tested rig segments")
    for number, t_ns in enumerate(instants_ns, start=1):
        outlet.output(frame(number, t_ns, known=number != 7))
    pulled = [joints.pull_sample(timeout=5.0) for _ in instants_ns]
    description = joints.info(timeout=5.0)
    return Received(
        description.nominal_srate(),
        description.get_channel_labels(),
        description.get_channel_units(),
        [row for row, _ in pulled],
        [stamp for _, stamp in pulled],
        segments.pull_sample(timeout=5.0)[0],
        joints.time_correction(timeout=5.0),
    )


@pytest.mark.system
def test_a_receiver_gets_frames_with_instants_and_units(lsl: Any) -> None:
    # The instants of the frames are earlier than their transmission, as in the daemon.
    began_ns, began_s = time.monotonic_ns(), lsl.local_clock()
    instants_ns = [began_ns - 40_000_000 + 10_000_000 * k for k in range(1, 21)]
    found = send_and_receive(lsl, instants_ns)
    assert found.rate_hz == RATE_HZ
    assert found.labels[:4] == [
        "knee_flexion", "knee_adduction", "knee_rotation", "knee_angle_sd",
    ]  # fmt: skip
    assert found.units[3:5] == ["rad", "meters"]
    expected = began_s + (np.array(instants_ns) - began_ns) * 1e-9
    np.testing.assert_allclose(found.stamps, expected, atol=2e-3)
    np.testing.assert_allclose(np.diff(found.stamps), 0.01, atol=1e-5)
    assert abs(found.correction_s) < 2e-3
    assert found.joints[0][:7] == pytest.approx([0.01, 0.2, 0.3, 0.04, 0.1, 0.2, 0.3])
    assert all(math.isnan(value) for value in found.joints[6][:3])
    assert found.segments == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.02])


@pytest.mark.parametrize(
    ("stub", "remedy"),
    [(None, r"pip install 'jointfitd\[lsl\]'"), ("library", "PYLSL_LIB")],
)
def test_a_missing_package_or_library_is_named_with_its_remedy(
    stub: str | None, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pylsl", None)
    if stub is not None:
        monkeypatch.delitem(sys.modules, "pylsl")

        class NoLibrary:
            def find_spec(self, name: str, *_: object) -> None:
                if name == "pylsl":
                    raise RuntimeError("LSL binary library file was not found.")

        monkeypatch.setattr(sys, "meta_path", [NoLibrary(), *sys.meta_path])
    with pytest.raises(LslError, match=remedy):
        LslOutlet(LslSettings(), "bench-1", RATE_HZ).start()
