"""Warnings of the can-table decoder that state why no sample is complete."""

from __future__ import annotations

from typing import Any

import pytest

from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_drivers.can_table import CanTableDecoder
from jointfit_protocols.can import CanFrame, pack_frames
from tests.drivers.self_described import HALVES, PAGES, can_settings

HALF = bytes(range(8))
FIRST, SECOND = 0x19FF0010, 0x19FF0011
"""Identifiers of the frames of `HALVES`."""


def warnings(table: dict[str, Any], *frames: tuple[int, bytes]) -> list[str]:
    """Return the warnings after 300 repetitions of frames, each with identifier and data."""
    settings = can_settings("socketcan", "can0", table)
    decoder = CanTableDecoder(settings.can_table(), settings.sample_form())
    sent = [
        CanFrame(10_000_000 * at + 1000 * number, can_id, data, extended=can_id > 0x7FF)
        for at in range(300)
        for number, (can_id, data) in enumerate(frames)
    ]
    out = decoder.feed(Chunk(0, pack_frames(sent)))
    return [item.text for item in out if isinstance(item, DeviceEvent) and item.kind == "warning"]


def test_a_frame_that_the_device_does_not_send_is_named() -> None:
    for sent, name, absent in ((FIRST, "second", SECOND), (SECOND, "first", FIRST)):
        (text,) = warnings(HALVES, (sent, HALF))
        assert text == (
            f"no complete sample, because {name} (0x{absent:X}) never arrived: switch the frames "
            "on in the device, or correct `ids`"
        )


def test_the_wrong_order_of_frames_is_named() -> None:
    (text,) = warnings(HALVES, (SECOND, HALF), (FIRST, HALF))
    assert "correct `sequence`" in text


@pytest.mark.parametrize("sent", [b"\x55\x03", b"\x54\x01"])
def test_frames_with_other_first_bytes_are_no_silent_loss(sent: bytes) -> None:
    """Frames whose first bytes differ from `starts_with` are reported."""
    (text,) = warnings(PAGES, (0x200, sent + bytes(6)))
    assert "because first (0x200), second (0x200) never arrived; 300 frames have these" in text
    assert "correct `starts_with` or `dbc`" in text
