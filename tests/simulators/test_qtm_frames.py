"""Missing positions in the components that the simulated QTM server sends."""

from __future__ import annotations

from jointfit_protocols import qtm
from jointfit_protocols.qtm import ComponentType
from jointfit_simulators.devices import RigidBodyAsset
from jointfit_simulators.devices._natnet_frames import axes_from_z_up
from jointfit_simulators.devices._qtm_frames import components

BODY = RigidBodyAsset("Thigh", ("T1",), 1)
KINDS = (ComponentType.MARKERS_RESIDUAL, ComponentType.BODIES_RESIDUAL, ComponentType.TIMECODE)


def test_all_bits_of_missing_positions_are_set_and_no_other_number_changes() -> None:
    ticks = 0x7FC0_0000_7FC0_0000  # contains the bytes of the usual NaN
    parts = components(KINDS, {}, {}, assets=(BODY,), axes=axes_from_z_up("z"), camera_ticks=ticks)
    data = qtm.encode(qtm.DataFrame(0x7FC0_0000, 0x7FC0_0000, tuple(parts)))
    assert data.count(b"\xff" * 12) == 5  # 12 bytes of the marker, 48 of the body
    frame = qtm.decode(data)
    assert isinstance(frame, qtm.DataFrame)
    assert (frame.timestamp_us, frame.number) == (0x7FC0_0000, 0x7FC0_0000)
    (code,) = [part for part in frame.components if isinstance(part, qtm.TimecodeComponent)]
    assert code.timecodes[0].camera_ticks == ticks
