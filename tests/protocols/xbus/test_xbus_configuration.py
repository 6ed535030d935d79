"""Setup messages of Xbus devices survive a round trip, and have the documented bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus import configuration as setup

if TYPE_CHECKING:
    from pathlib import Path

byte, word, long = st.integers(0, 0xFF), st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)
PAIRS: list[tuple[Any, Any, Any]] = [
    (
        setup.encode_outputs,
        setup.decode_outputs,
        st.lists(st.builds(setup.Output, word, word)).map(tuple),
    ),
    (
        setup.encode_sync,
        setup.decode_sync,
        st.lists(st.builds(setup.SyncSetting, byte, byte, byte, byte, word, word, word, word)).map(
            tuple
        ),
    ),
    (
        setup.encode_firmware,
        setup.decode_firmware,
        st.builds(setup.Firmware, byte, byte, byte, long, long),
    ),
    (
        setup.encode_alignment,
        setup.decode_alignment,
        st.builds(setup.AlignmentRotation, byte, st.tuples(*[st.floats(-2, 2, width=32)] * 4)),
    ),
]


@pytest.mark.parametrize(("write", "read", "values"), PAIRS)
@given(data=st.data())
def test_encoded_configuration_decodes_to_itself(
    write: Any, read: Any, values: Any, data: st.DataObject
) -> None:
    value = data.draw(values)
    assert read(write(value)) == value


@pytest.mark.parametrize("read", [pair[1] for pair in PAIRS])
@given(data=st.binary(max_size=40))
def test_reading_any_configuration_does_not_raise(read: Any, data: bytes) -> None:
    read(data)


@given(st.binary(max_size=40))
def test_reading_any_text_does_not_raise(data: bytes) -> None:
    setup.decode_text(data)
    setup.decode_device_id(data)
    setup.decode_filter_profile(data)


@pytest.mark.parametrize(
    ("mid", "data", "wire"),
    [
        (
            XbusMessageId.OUTPUT_CONFIGURATION,
            setup.encode_outputs(
                [(0x1020, 0xFFFF), (0x1060, 0xFFFF), (0xE020, 0xFFFF), (0x2010, 100)]
            ),
            "faffc0101020ffff1060ffffe020ffff2010006403",
        ),
        (
            XbusMessageId.SYNC_SETTINGS,
            setup.encode_sync([setup.SyncSetting(9, 2, 1, delay=1000)]),
            "faff2c0c0902010000000000000003e8d2",
        ),
    ],
)
def test_documented_bytes(mid: int, data: bytes, wire: str) -> None:
    assert encode(mid, data).hex() == wire


def test_both_forms_of_the_device_id_read_as_on_the_label() -> None:
    assert setup.decode_device_id(bytes.fromhex("0360a1b2")) == "0360A1B2"
    assert setup.decode_device_id(bytes.fromhex("000000000080c3d4")) == "0080C3D4"


@pytest.mark.parametrize(
    ("product", "modulus"),
    [
        ("MTi-1-8A7G6", 2**32),
        ("MTi-3-8A7G6", 2**32),
        ("MTi-630-8A1G6", 2**32),
        ("MTi-680G-SK", 2**32),
        ("MTi-10-2A5G4", 864_000_000),
        ("MTi-20-2A5G4", 864_000_000),
        ("MTi-30-2A8G4", 864_000_000),
        ("MTi-100-2A5G4", 864_000_000),
        ("MTi-200-2A5G4", 864_000_000),
        ("MTi-G-710-GNSS", 864_000_000),
        ("MTi-300-AHRS", 864_000_000),
        ("MTi-G-700-GPS", 864_000_000),
        ("Avior", None),
        ("", None),
    ],
)
def test_clock_wrap_follows_from_the_device_model(product: str, modulus: int | None) -> None:
    assert setup.fine_time_modulus(product) == modulus


def test_errors_have_the_codes_of_the_manual() -> None:
    texts = {0x03: "period", 0x04: "message", 0x1E: "output buffer", 0x20: "baud rate",
             0x21: "parameter", 0x28: "device error"}  # fmt: skip
    for code in range(256):
        assert setup.error_text(code).startswith(
            f"error 0x{code:02X}, {texts.get(code, 'unknown to this version')}"
        )


def test_a_tick_lasts_100_us_and_a_setting_may_leave_out_its_tail() -> None:
    assert setup.TICK_NS == 100_000
    assert setup.encode_sync([setup.SyncSetting(4, 2, 1)]).hex() == "04020100" + "0000" * 4
    assert setup.MAX_RATE == 0xFFFF


def test_a_filter_profile_is_a_code_or_a_label() -> None:
    assert setup.decode_filter_profile(bytes.fromhex("0b01")) == "2817"
    assert setup.decode_filter_profile(b"Responsive/VRU  ") == "Responsive/VRU"


def test_the_recorded_output_configurations_read_as_their_text(shared_data: Path) -> None:
    folder = shared_data / "imu" / "xsens"
    counts = []
    for number in "135":
        outputs = setup.decode_outputs((folder / f"{number}.outputconfig.bin").read_bytes())
        assert outputs is not None
        text = (folder / f"{number}.outputconfig.golden").read_text(encoding="utf-8")
        rates = [line.split()[0] for line in text.splitlines()[1::2]]
        assert [
            "Max" if output.rate == setup.MAX_RATE else str(output.rate) for output in outputs
        ] == rates
        counts.append(len(outputs))
    assert counts == [13, 13, 14]
