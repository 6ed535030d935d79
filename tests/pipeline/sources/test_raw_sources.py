"""Sources with an orientation filter on the gateway: health and heading warnings."""

from __future__ import annotations

from typing import Any

import pytest

from jointfit_daemon.config import heading_warning, parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.payloads._health_encoding import core_payload
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, Notice, SourceOpened
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus.mtdata2 import Item, encode_items
from tests.pipeline import core_feed

pytest.importorskip("vqf")


def rig(*magnetometers: bool) -> Any:
    table = core_feed.table()
    raw = [imu for imu in table["imu"] if imu["driver"] == "xbus"]
    for imu, magnetometer in zip(raw, magnetometers, strict=False):
        imu |= {"orientation": "gateway", "magnetometer": magnetometer}
    return parse_rig(table)


def message(k: int) -> bytes:
    return encode(
        XbusMessageId.MT_DATA2,
        encode_items(
            [
                (Item.PACKET_COUNTER, k),
                (Item.SAMPLE_TIME_FINE, 100 * k),
                (Item.RATE_OF_TURN, (0.01, 0.0, 0.0)),
                (Item.ACCELERATION, (0.0, 0.0, 9.81)),
            ]
        ),
    )


@pytest.mark.parametrize("alike", [(True, True), (False, False), (True,), (False,), ()])
def test_equal_heading_references_give_no_warning(alike: tuple[bool, ...]) -> None:
    assert heading_warning(rig(*alike).sources) is None


def test_mixed_heading_references_give_a_warning_at_the_start() -> None:
    mixed = rig(True, False)
    outputs = Core().feed(Configured(1, mixed, None))
    told = [out for out in outputs if isinstance(out, Notice) and out.level == "warning"]
    assert len(told) == 1
    assert "magnetometer used for S1, but not for S3" in told[0].text


def test_health_of_a_raw_source_contains_rest_and_bias() -> None:
    core = Core()
    core.feed(Configured(1, rig(False), None))
    core.feed(SourceOpened(2, "S1"))
    for k in range(1500):
        core.feed(ChunkArrived("S1", Chunk(k * 10_000_000 + 3, message(k))))
    devices: Any = core_payload(core.health(15_000_000_000))["devices"]
    said = devices["S1"]["orientation_filter"]
    assert said["rest"] is True
    assert said["bias_rad_s"] == pytest.approx([0.01, 0.0, 0.0], abs=1e-3)
    assert said["settled"] is True
    assert devices["S1"]["received"] == 1500 - 149  # the filter settles during the first 1.5 s
    assert "orientation_filter" not in devices["S3"]
