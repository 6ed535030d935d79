"""Commands and data packets of both LPMS generations agree with the vendor's documents."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.lpms import LpBusCodec, LpBusMessage, QuaternionScale, encode, unit_of
from jointfit_protocols.lpms.configuration import (
    GENERATION_1,
    GENERATION_3,
    TABLES,
    LpmsCommand,
    LpmsConfiguration,
    decode_configuration,
    decode_firmware,
    decode_set,
    encode_configuration,
    encode_firmware,
    identify_generation,
    sends_seconds,
    set_command,
)
from jointfit_protocols.lpms.measurement import PacketLayout, seconds_of, tick_of
from jointfit_protocols.orientation import canonical

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_protocols.lpms.configuration import CommandTable

GENERATIONS = pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.generation)
configurations = st.builds(
    LpmsConfiguration,
    st.sampled_from([0x400, 0x800, 0x1000, 0x1C00]),
    st.sampled_from([5, 10, 50, 100]),
    st.booleans(),
)


def vectors(shared_data: Path) -> dict[str, dict[str, Any]]:
    everything = json.loads((shared_data / "imu" / "vectors.json").read_text())
    return {each["id"]: each for each in everything if each["protocol"] == "lpms-lpbus"}


@pytest.mark.parametrize(
    ("vector", "table", "part"),
    [
        ("lp1-set-transmit-quat", GENERATION_1, LpmsConfiguration(GENERATION_1.quaternion)),
        (
            "lp1-set-transmit-quat-euler",
            GENERATION_1,
            LpmsConfiguration(GENERATION_1.mask("quaternion", "euler")),
        ),
        ("lp1-set-freq-100", GENERATION_1, LpmsConfiguration(rate_hz=100)),
        ("lp3-set-transmit-quat", GENERATION_3, LpmsConfiguration(GENERATION_3.quaternion)),
        ("lp3-set-freq-100", GENERATION_3, LpmsConfiguration(rate_hz=100)),
    ],
)
def test_vectors_of_settings(
    shared_data: Path, vector: str, table: CommandTable, part: LpmsConfiguration
) -> None:
    ((command, data),) = set_command(table, part)
    assert encode(command, data).hex() == vectors(shared_data)[vector]["hex"]
    assert decode_set(table, command, data) == part


def test_vectors_of_requests(shared_data: Path) -> None:
    requests = {
        "lp-goto-command": LpmsCommand.COMMAND_MODE,
        "lp-goto-stream": LpmsCommand.STREAM_MODE,
        "lp-ack": LpmsCommand.ACK,
        "lp-nack": LpmsCommand.NACK,
        "lp-poll": LpmsCommand.DATA,
        "lp3-get-transmit": GENERATION_3.reads[0],
    }
    for vector, command in requests.items():
        assert encode(command).hex() == vectors(shared_data)[vector]["hex"]


def test_vectors_of_measurements(shared_data: Path) -> None:
    known = vectors(shared_data)
    measured = {key: each for key, each in known.items() if "tick" in each.get("decoded", {})}
    assert len(measured) == 5
    for key, vector in measured.items():
        config = vector.get("config", {"generation": 3, "transmit": hex(GENERATION_3.quaternion)})
        layout = PacketLayout(TABLES[config["generation"]], int(config["transmit"], 16))
        (message,) = LpBusCodec().feed(bytes.fromhex(vector["hex"]))
        assert isinstance(message, LpBusMessage)
        measurement = layout.decode(message.data)
        assert measurement is not None, key

        decoded = vector["decoded"]
        sent = measurement.values[layout.places["quaternion"]]
        assert measurement.tick == decoded["tick"]
        assert measurement.floats == ("raw" not in decoded)
        if "raw" in decoded:
            assert list(sent) == decoded["raw"]
        unit = 1 if measurement.floats else unit_of(sent)
        assert unit == {"lp-data-i16": 10_000, "lp-data-i16-old": 1_000}.get(key, 1)
        w, x, y, z = (value / unit for value in sent)
        assert [w, x, y, z] == pytest.approx(decoded["native_wxyz"], abs=1e-12)
        found = canonical((w, x, y, z), "NWU", world_to_sensor=True)
        assert list(found) == pytest.approx(decoded["canonical_wxyz"], abs=2e-8)
        again = layout.encode(measurement.tick, measurement.values, floats=measurement.floats)
        assert again == message.data


@GENERATIONS
@given(st.data())
def test_settings_read_as_they_were_sent(table: CommandTable, data: st.DataObject) -> None:
    sent = data.draw(configurations)
    found = LpmsConfiguration()
    for command in table.reads:
        reply = encode_configuration(table, command, sent)
        part = decode_configuration(table, command, reply)
        assert part is not None
        found = found.merge(part)
    assert found == sent

    made = LpmsConfiguration()
    for command, value in set_command(table, sent):
        part = decode_set(table, command, value)
        assert part is not None
        made = made.merge(part)
    assert made == sent


def test_outputs_have_the_order_and_bits_of_the_register_headers() -> None:
    first, third = (
        [(output.name, output.bit, output.values) for output in table.outputs]
        for table in (GENERATION_1, GENERATION_3)
    )
    assert first == [
        ("gyro_raw", 12, 3), ("accelerometer_raw", 11, 3), ("magnetometer_raw", 10, 3),
        ("angular_velocity", 16, 3), ("quaternion", 18, 4), ("euler", 17, 3),
        ("linear_acceleration", 21, 3), ("pressure", 9, 1), ("altitude", 19, 1),
        ("temperature", 13, 1), ("heave", 14, 1),
    ]  # fmt: skip
    assert third == [
        ("accelerometer_raw", 0, 3), ("accelerometer", 1, 3), ("gyro0_raw", 2, 3),
        ("gyro1_raw", 3, 3), ("gyro0_bias_calibrated", 4, 3), ("gyro1_bias_calibrated", 5, 3),
        ("gyro0", 6, 3), ("gyro1", 7, 3), ("magnetometer_raw", 8, 3), ("magnetometer", 9, 3),
        ("angular_velocity", 10, 3), ("quaternion", 11, 4), ("euler", 12, 3),
        ("linear_acceleration", 13, 3), ("pressure", 14, 1), ("altitude", 15, 1),
        ("temperature", 16, 1),
    ]  # fmt: skip
    mask = GENERATION_3.mask("gyro0", "temperature")
    assert (mask, GENERATION_3.names(mask)) == (0x1_0040, ["gyro0", "temperature"])


def test_commands_and_rates_are_those_of_the_register_headers() -> None:
    first, third = (
        (
            table.set_outputs, table.set_rate, table.set_precision, table.store,
            table.factory_reset, table.read_firmware, table.reads, table.tick_hz,
        )
        for table in (GENERATION_1, GENERATION_3)
    )  # fmt: skip
    assert first == (0x0A, 0x0B, 0x4B, 0x0F, 0x10, 0x2F, (0x04,), 400)
    assert third == (0x1E, 0x22, 0x88, 0x04, 0x05, 0x15, (0x1F, 0x23, 0x89), 500)
    assert GENERATION_1.rates_hz == (5, 10, 25, 50, 100, 200, 400)
    assert GENERATION_3.rates_hz == (5, 10, 50, 100, 250, 500, 1000)
    assert [command.value for command in LpmsCommand] == [0, 1, 6, 7, 9, 0x5B]


def test_the_configuration_word_of_generation_1_has_outputs_rate_and_precision() -> None:
    (read,) = GENERATION_1.reads
    word = (0x0044_0006).to_bytes(4, "little")  # quaternion, int16, highest rate code
    found = LpmsConfiguration(0x0004_0000, 400, floats=False)
    assert decode_configuration(GENERATION_1, read, word) == found
    assert encode_configuration(GENERATION_1, read, found) == word
    no_rate = decode_configuration(GENERATION_1, read, (0x7).to_bytes(4, "little"))
    assert no_rate == LpmsConfiguration(0, None, floats=True)
    assert decode_configuration(GENERATION_1, read, word[:-1]) is None
    assert decode_configuration(GENERATION_1, read + 1, word) is None


def test_a_reply_of_generation_3_has_one_setting() -> None:
    replies = [
        decode_configuration(GENERATION_3, command, b"\1\0\0\0") for command in GENERATION_3.reads
    ]
    assert replies == [
        LpmsConfiguration(outputs=1), LpmsConfiguration(rate_hz=1), LpmsConfiguration(floats=True),
    ]  # fmt: skip
    with pytest.raises(ValueError, match="every setting must be known"):
        encode_configuration(GENERATION_3, 0x1F, LpmsConfiguration(outputs=1, rate_hz=5))


@GENERATIONS
def test_other_commands_set_no_setting(table: CommandTable) -> None:
    assert set_command(table, LpmsConfiguration()) == []
    assert decode_set(table, table.store, bytes(4)) is None
    assert decode_set(table, table.set_rate, bytes(3)) is None


def test_the_two_generations_count_precision_in_opposite_senses() -> None:
    sixteen = LpmsConfiguration(floats=False)
    assert set_command(GENERATION_1, sixteen) == [(0x4B, b"\1\0\0\0")]
    assert set_command(GENERATION_3, sixteen) == [(0x88, b"\0\0\0\0")]


def test_a_read_of_one_generation_is_a_write_of_the_other() -> None:
    assert GENERATION_3.store in GENERATION_1.reads
    assert GENERATION_3.factory_reset == 0x05  # reads the status in generation 1


@GENERATIONS
@given(st.integers(0, 2**24 - 1), st.integers(0, 2**32 - 1), st.booleans(), st.data())
def test_a_packet_of_any_outputs_decodes_to_itself(
    table: CommandTable, mask: int, tick: int, floats: bool, data: st.DataObject
) -> None:
    layout = PacketLayout(table, mask)
    kind = st.floats(width=32, allow_nan=False) if floats else st.integers(-32768, 32767)
    values = data.draw(st.lists(kind, min_size=layout.values, max_size=layout.values))
    wire = layout.encode(tick, values, floats=floats)
    found = layout.decode(wire)
    assert found is not None
    assert (found.tick, found.values) == (tick, tuple(values))
    assert list(layout.places) == [
        output.name for output in table.outputs if mask >> output.bit & 1
    ]
    if layout.values:
        assert found.floats == floats
    assert layout.decode(wire + b"\0") is None


def test_a_quaternion_alone_has_the_same_packet_in_both_generations() -> None:
    sizes = [PacketLayout(table, table.quaternion).sizes for table in TABLES.values()]
    assert sizes == [(20, 12), (20, 12)]


@pytest.mark.parametrize(
    ("data", "generation"),
    [
        (b"LPMS-CU2\0\0\0\0\0\0\0\0", 1),
        (b"B2\0\0", 1),
        (b"\x02\0\0\0", 3),
        (b"\0\0\0\0", 3),
        (b"\x02\0\0\1", None),
        (b" ~", 1),
        (b"\x1f", None),
        (b"\x7f", None),
        (bytes(5), None),
        (b"", None),
        (b"\xff\xfe\xfd", None),
    ],
)
def test_the_reply_to_5b_identifies_the_generation(data: bytes, generation: int | None) -> None:
    assert identify_generation(data) == generation


def test_firmware_is_three_numbers_or_a_text() -> None:
    assert encode_firmware(GENERATION_1, "2.0.5")[:4] == b"\5\0\0\0"
    for table, version in ((GENERATION_1, "1.3.4"), (GENERATION_3, "LPMS-3.1.7")):
        assert decode_firmware(table, encode_firmware(table, version)) == version
    assert decode_firmware(GENERATION_1, b"text") is None
    assert decode_firmware(GENERATION_3, bytes(24)) is None


def test_firmware_up_to_1_3_4_sends_seconds() -> None:
    assert [sends_seconds(version) for version in ("1.3.4", "1.0.9", "1.3.5", "2.0.1")] == [
        True, True, False, False,
    ]  # fmt: skip
    assert seconds_of(tick_of(12.5)) == 12.5


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01),
    st.sampled_from([10_000, 1_000, 32_767]),
)
def test_the_norm_of_integers_shows_their_unit(q: tuple[float, ...], unit: int) -> None:
    norm = sum(value * value for value in q) ** 0.5
    assert unit_of([round(value / norm * unit) for value in q]) == unit


def test_a_single_quaternion_of_another_unit_does_not_change_the_scale() -> None:
    scale = QuaternionScale()
    assert scale.feed((5, 5, 5, 5)) is None
    assert scale.feed((10_000, 0, 0, 0)) == 10_000
    assert scale.feed((1_000, 0, 0, 0)) == 10_000
    assert scale.feed((0, 10_000, 0, 0)) == 10_000
    assert [scale.feed((1_000, 0, 0, 0)) for _ in range(10)] == [10_000] * 9 + [1_000]
    assert QuaternionScale(32_767).feed((1_000, 0, 0, 0)) == 32_767
