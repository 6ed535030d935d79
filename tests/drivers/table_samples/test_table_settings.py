"""Tables in rig.toml: faults with key and remedy; the shipped tables decode test vectors."""

from __future__ import annotations

import json
import re
import struct
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.config import ConfigError, load_rig, parse_rig
from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_daemon.tools.decoder_settings import decoder_settings
from jointfit_drivers.can_table import CanTableSettings
from jointfit_drivers.can_table._dbc import read_signals
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.orientation import canonical
from jointfit_protocols.table import CanSample, CanTableCodec, Multiplexer

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "self-described.toml"
DBC = """VERSION ""
BU_: H
BO_ 304 INFO: 4 H
 SG_ TIME : 0|32@1+ (1,0) [0|0] "us" H
BO_ 305 QUAT: 8 H
 SG_ Q0 : 7|16@0- (0.0001,0) [0|0] "" H
 SG_ Q1 : 23|16@0- (0.0001,0) [0|0] "" H
 SG_ Q2 : 39|16@0- (0.0001,0) [0|0] "" H
 SG_ Q3 : 55|16@0- (0.0001,0) [0|0] "" H
BO_ 306 MUXED: 8 H
 SG_ M M : 0|8@1+ (1,0) [0|0] "" H
 SG_ A m0 : 8|16@1- (1,0) [0|0] "" H
BO_ 307 OTHER: 8 H
 SG_ Q0 : 7|16@0- (0.0001,0) [0|0] "" H
"""


def rig_of(table: dict[str, Any]) -> dict[str, Any]:
    """Return a rig whose second sensor has this table."""
    rig = tomllib.loads(EXAMPLE.read_text(encoding="utf-8"))
    head = {"id": "S2", "segment": "thigh"}
    head |= {"can": "can0"} if table["driver"] == "can-table" else {"port": "/dev/ttyUSB7"}
    rig["imu"][1] = head | table
    return rig


def faults(table: dict[str, Any]) -> list[str]:
    try:
        parse_rig(rig_of(table))
    except ConfigError as error:
        return [fault.text() for fault in error.faults]
    return []


def serial(fields: dict[str, Any], **more: Any) -> dict[str, Any]:
    frame = {"sync": "AA 55", "length": 20, "checksum": {"kind": "crc16"}}
    return {"driver": "serial-table", "frame": frame, "fields": fields} | more


def on_can(fields: dict[str, Any], **more: Any) -> dict[str, Any]:
    ids = {"time": 0x100, "quaternion": 0x200}
    return {"driver": "can-table", "ids": ids, "fields": fields} | more


Q = {"offset": 2, "type": "i16", "divisor": 32767}


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        (serial({"quaternion": Q | {"offset": 1}}), "shares byte 1 with frame.sync"),
        (serial({"quaternion": Q | {"offset": 11}}), "ends at byte 18, but the frame has room up"),
        (
            serial({"quaternion": Q, "counter": {"offset": 9, "type": "u8"}}),
            "fields.counter: shares byte 9 with fields.quaternion: correct offset or type",
        ),
        (serial({"quaternion": Q | {"type": "int16"}}), "'int16' is no type: expected u1 to u64"),
        (serial({"quaternion": Q | {"type": "i1"}}), "'i1' is no type: expected u1 to u64, i2 to"),
        (serial({"quaternion": Q | {"order": "wxy"}}), "component z is missing"),
        (serial({"quaternion": Q | {"order": "abcd"}}), "expected letters of 'wxyz'"),
        (serial({"quaternion": Q | {"scale": 2.0}}), "expected either `scale` or `divisor`"),
        (serial({"quaternion": Q | {"column": 3}}), "is for text lines: give `offset`"),
        (serial({"quaternion": Q, "time": {"offset": 10, "type": "u32"}}), "the unit of one count"),
        (
            serial({"quaternion": Q, "time": {"offset": 10, "type": "u32", "unit": "min"}}),
            "'min' is no unit of time: expected one of s, ms, 100us, us, ns",
        ),
        (serial({"rate": Q}), 'no quaternion: add it, or set orientation = "gateway"'),
        (serial({}), "expected a quaternion, or rate and acceleration"),
        (serial({"quaternion": Q}, frame={"sync": "AA5"}), "expected bytes in hexadecimal"),
        (serial({"quaternion": Q}, frame={"sync": "AA"}), "either `length` or `length_field`"),
        (
            serial({"quaternion": Q}, text={"columns": 3}),
            "expected either `frame` or `text`: remove one",
        ),
        (
            {
                "driver": "serial-table",
                "text": {"columns": 4},
                "fields": {"quaternion": {"column": 2}},
            },
            "needs column 5, but a line has 4",
        ),
        (
            {
                "driver": "serial-table",
                "text": {},
                "fields": {"quaternion": {"column": 2}, "counter": {"column": 5}},
            },
            "shares column 5 with fields.quaternion",
        ),
        (
            on_can(
                {"quaternion": Q | {"offset": 1}, "time": {"offset": 0, "type": "u8", "unit": "s"}}
            ),
            "ends at byte 8, but the frame has room up to byte 7",
        ),
        (on_can({"quaternion": Q | {"offset": 0}}), "ids.time: no field is in this frame"),
        (
            on_can({"quaternion": Q | {"offset": 0, "frame": "other"}}),
            "'other' is no frame of `ids`: expected one of time, quaternion",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, ids={"a": 0x200, "b": 0x200}),
            "ids.b: 0x200 is also the identifier of a",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, ids={"quaternion": 0x181}),
            "ids.quaternion: id 0x181 on this bus belongs to S2",
        ),
        (
            on_can(
                {"quaternion": Q | {"offset": 0}},
                ids={"a": 0x200, "b": 0x200},
                starts_with={"a": "01", "b": "01 02"},
            ),
            "ids.b: 0x200 is also the identifier of a: correct one of them, or set `starts_with`",
        ),
        (
            on_can(
                {"quaternion": Q | {"offset": 0}},
                ids={"quaternion": 0x200},
                starts_with={"quaternion": "01"},
            ),
            "fields.quaternion: shares byte 0 with starts_with.quaternion: correct offset or type",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, starts_with={"quat": "01"}),
            "starts_with.quat: expected a name of `ids`: time, quaternion",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, starts_with={"quaternion": "0x1"}),
            "starts_with.quaternion = '0x1': expected bytes in hexadecimal",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, starts_with={"quaternion": "00" * 9}),
            "expected 1 to 8 bytes in hexadecimal",
        ),
        (
            on_can({"quaternion": Q | {"offset": 0}}, sequence=["quaternion"]),
            "sequence = ('quaternion',): expected each name of `ids` once: time, quaternion",
        ),
        (on_can({"quaternion": {"signals": ["Q0"] * 4}}), "needs a file: set `dbc`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_wrong_table_is_reported_with_its_remedy(table: dict[str, Any], expected: str) -> None:
    found = faults(table)
    assert any(expected in text for text in found), found
    assert not any("report it to its author" in text for text in found), found


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, None),
        ({"signals": ["Q0", "Q1", "Q2", "Q3"]}, "name one of QUAT.Q0, OTHER.Q0"),
        ({"signals": ["QUAT.Q0", "Q1", "Q2", "Q9"]}, "has no signal 'Q9'; it has A, M, Q0"),
        ({"signals": ["QUAT.Q0", "Q1", "Q2", "A"]}, "the frame 0x132, which is not in `ids`"),
        ({"signals": ["OTHER.Q0", "Q1", "Q2", "Q3"]}, "the frame 0x133, which is not in `ids`"),
        ({"signals": ["QUAT.Q0", "Q1"]}, "2 signals for 4 components"),
        ({"signals": ["QUAT.Q0", "Q1", "Q1", "Q3"]}, "components overlap"),
        ({"offset": 0}, "is in the DBC file: remove it"),
    ],
)
def test_signals_of_a_dbc_file(
    tmp_path: Path, change: dict[str, Any], expected: str | None
) -> None:
    pytest.importorskip("cantools")
    (tmp_path / "s.dbc").write_text(DBC)
    quaternion = {"signals": ["QUAT.Q0", "Q1", "Q2", "Q3"]} | change
    fields = {"quaternion": quaternion, "time": {"signals": ["TIME"]}}
    table = on_can(fields, dbc=str(tmp_path / "s.dbc"), ids={"time": 304, "quaternion": 305})
    found = faults(table | {"fields": fields | {"time": {"signals": ["TIME"], "unit": "us"}}})
    assert (found == []) if expected is None else any(expected in text for text in found), found


def test_a_dbc_file_that_overlaps_or_is_missing_is_named(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    fields = {"quaternion": {"signals": ["QUAT.Q0", "Q1", "Q2", "Q3"]}}
    table = on_can(fields, dbc=str(tmp_path / "no.dbc"), ids={"q": 305})
    assert any("No such file or directory: correct the name in `dbc`" in t for t in faults(table))
    (tmp_path / "no.dbc").write_text(DBC.replace("23|16", "15|16"))
    assert any("overlapping in message QUAT" in text for text in faults(table))


def test_a_signed_signal_of_one_bit_is_named(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    fields = {
        "quaternion": {"signals": ["QUAT.Q0", "Q1", "Q2", "Q3"]},
        "valid": {"signals": ["OK"], "frame": "state"},
    }
    table = on_can(fields, dbc=str(tmp_path / "s.dbc"), ids={"state": 300, "quaternion": 305})
    state = 'BO_ 300 STATE: 1 H\n SG_ OK : 0|1@1{} (1,0) [0|0] "" H\n'
    (tmp_path / "s.dbc").write_text(DBC + state.format("+"))
    assert faults(table) == []
    (tmp_path / "s.dbc").write_text(DBC + state.format("-"))
    (fault,) = faults(table)
    assert "STATE.OK is signed and has 1 bit, so it can only be 0 or -1: declare it" in fault


def test_a_missing_package_is_named_before_the_bus_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_drivers.can_table._dbc.find_spec", lambda _: None)
    table = on_can({"quaternion": {"signals": ["A"] * 4}}, dbc="x.dbc", ids={"q": 305})
    assert any("pip install 'jointfitd[dbc]'" in text for text in faults(table))


def test_the_name_of_a_dbc_file_is_relative_to_the_rig(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    (tmp_path / "s.dbc").write_text(DBC)
    text = EXAMPLE.read_text(encoding="utf-8")
    dbc = 'dbc = "s.dbc"\n[imu.fields]\nquaternion = { signals = ["QUAT.Q0", "Q1", "Q2", "Q3"] }\n'
    ids = f"ids = {{ quaternion = 305 }}\n{dbc}\n"
    text = re.sub(r"ids = \{ time = 0x130.*?\n\n", ids, text, flags=re.DOTALL)
    (tmp_path / "rig.toml").write_text(text)
    source = load_rig(tmp_path / "rig.toml").sources[1]
    place = source.settings.places().fields[1]
    assert (place.offset, place.bits, place.byte_order, place.scale) == (2, 16, "big", 1e-4)


# --- shipped tables -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example() -> Rig:
    return load_rig(EXAMPLE)


def samples_of(rig: Rig, name: str, data: bytes) -> list[ImuSample]:
    source = next(source for source in rig.sources if source.id == name)
    decoder = find_driver(source.settings.driver)(source.settings).decoder()
    return [item for item in decoder.feed(Chunk(1, data)) if isinstance(item, ImuSample)]


def test_the_table_of_sbg_decodes_the_vectors(example: Rig, shared_data: Path) -> None:
    vectors = {
        each["id"]: each for each in json.loads((shared_data / "imu/vectors.json").read_text())
    }
    frames = [
        CanFrame(at, vectors[name]["can_id"], bytes.fromhex(vectors[name]["hex"]))
        for at, name in enumerate(("sbg-info", "sbg-quat"))
    ]
    (sample,) = samples_of(example, "S2", pack_frames(frames))
    expected = vectors["sbg-quat"]["decoded"]
    assert sample.q_native == pytest.approx(expected["native_wxyz"], abs=1e-12)
    assert sample.q_world_sensor == pytest.approx(expected["canonical_wxyz"], abs=1e-8)
    assert sample.ticks == vectors["sbg-info"]["decoded"]["time_us"]


def test_a_29_bit_table_decodes_its_vector(shared_data: Path) -> None:
    vectors = {
        each["id"]: each for each in json.loads((shared_data / "imu/vectors.json").read_text())
    }
    vector = vectors["can-quat16-be-29bit"]
    table = on_can(
        {"quaternion": Q | {"offset": 0}},
        ids={"quaternion": vector["can_id"]},
        extended_ids=True,
        byte_order="big",
    )
    frame = CanFrame(1, vector["can_id"], bytes.fromhex(vector["hex"]), extended=True)
    (sample,) = samples_of(parse_rig(rig_of(table)), "S2", pack_frames([frame]))
    assert sample.q_world_sensor == pytest.approx(vector["decoded"]["canonical_wxyz"], abs=1e-8)


def test_dbc_tables_decode_as_cantools_does(shared_data: Path) -> None:
    cantools: Any = pytest.importorskip("cantools")
    path = shared_data / "imu" / "dbc" / "sbg_ecan_att.dbc"
    fields = {
        "time": {"signals": ["TIME_STAMP"], "unit": "us"},
        "quaternion": {"signals": ["Q0", "Q1", "Q2", "Q3"]},
    }
    table = on_can(fields, dbc=str(path), ids={"time": 0x130, "quaternion": 0x131})
    rig = parse_rig(rig_of(table))
    database = cantools.database.load_file(path)
    data = struct.pack("<4h", -12345, 20000, 17000, 15000)
    frames = [CanFrame(1, 0x130, b"\x01\x02\x03\xf4"), CanFrame(2, 0x131, data)]
    (sample,) = samples_of(rig, "S2", pack_frames(frames))
    signals = database.decode_message(0x131, data)
    assert sample.q_native == tuple(signals[f"Q{at}"] for at in range(4))
    assert sample.ticks == database.decode_message(0x130, frames[0].data)["TIME_STAMP"]


PAGES = """VERSION ""
BU_: H
BO_ 512 RAW: 8 H
 SG_ PAGE M : {page} (1,0) [0|0] "" H
 SG_ NUMBER : 4|4@1+ (1,0) [0|0] "" H
 SG_ WX m1 : 23|16@0- (0.01,0) [0|0] "deg/s" H
 SG_ WY m1 : 39|16@0- (0.01,0) [0|0] "deg/s" H
 SG_ WZ m1 : 55|16@0- (0.01,0) [0|0] "deg/s" H
 SG_ AX m2 : 16|16@1- (0.001,0) [0|0] "g" H
 SG_ AY m2 : 32|16@1- (0.001,0) [0|0] "g" H
 SG_ AZ m2 : 48|16@1- (0.001,0) [0|0] "g" H
 SG_ TEMPERATURE m3M : 8|8@1- (1,0) [0|0] "" H
 SG_ Q0 m7 : 16|16@1- (1,0) [0|0] "" H
 SG_ Q1 m9 : 32|16@1- (1,0) [0|0] "" H
"""
PAGES += "".join(
    f"SG_MUL_VAL_ 512 {signal} {multiplexer} {first}-{last};\n"
    for first, last, multiplexer, signals in (
        (1, 1, "PAGE", "WX WY WZ"),
        (2, 2, "PAGE", "AX AY AZ"),
        (3, 3, "PAGE", "TEMPERATURE"),
        (7, 8, "TEMPERATURE", "Q0"),
        (9, 9, "TEMPERATURE", "Q1"),
    )
    for signal in signals.split()
)
"""DBC file of frames with one identifier. The multiplexer PAGE selects their content. The nested
multiplexer TEMPERATURE selects Q0 or Q1."""
RAW_SIGNALS = {
    "rate": {"signals": ["WX", "WY", "WZ"]},
    "acceleration": {"signals": ["AX", "AY", "AZ"]},
    "counter": {"signals": ["NUMBER"], "frame": "acceleration"},
}


@pytest.mark.parametrize("page", ["0|4@1+", "3|4@0+"])
def test_multiplexed_signals_decode_as_cantools_does(tmp_path: Path, page: str) -> None:
    pytest.importorskip("vqf")
    cantools: Any = pytest.importorskip("cantools")
    (tmp_path / "pages.dbc").write_text(PAGES.format(page=page))
    message = cantools.database.load_file(tmp_path / "pages.dbc").get_message_by_name("RAW")
    sent: list[dict[str, float]] = [
        {"PAGE": 1, "NUMBER": 5, "WX": 1.25, "WY": -2.5, "WZ": 300.0},
        {"PAGE": 3, "NUMBER": 5, "TEMPERATURE": 7, "Q0": 0},
        {"PAGE": 2, "NUMBER": 5, "AX": 0.25, "AY": -0.5, "AZ": 0.875},
    ]
    frames = [CanFrame(at, 512, message.encode(each, strict=False)) for at, each in enumerate(sent)]
    table = on_can(
        RAW_SIGNALS,
        dbc=str(tmp_path / "pages.dbc"),
        ids={"rate": 512, "acceleration": 512},
        orientation="gateway",
    )
    assert faults(table) == []
    settings = parse_rig(rig_of(table)).sources[1].settings
    assert isinstance(settings, CanTableSettings)
    can_table = settings.can_table()
    codec = CanTableCodec(can_table)
    (sample,) = filter(None, map(codec.feed, frames))
    assert isinstance(sample, CanSample)
    scales = [can_table.fields[slot].scale for slot in codec.slots]
    *rate, ax, ay, az, number = np.multiply(np.array(sample.values, float), scales)
    assert np.rad2deg(rate) == pytest.approx([1.25, -2.5, 300.0])
    assert np.divide([ax, ay, az], 9.80665) == pytest.approx([0.25, -0.5, 0.875])
    assert (number, codec.foreign) == (5, 1)


def test_signals_of_different_pages_in_one_frame_are_named(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    (tmp_path / "pages.dbc").write_text(PAGES.format(page="0|4@1+"))
    table = on_can(RAW_SIGNALS, dbc=str(tmp_path / "pages.dbc"), ids={"all": 512})
    text = "fields.acceleration: is not in the same frames as the rest of 'all'"
    (fault,) = faults(table)  # consequences of this fault are not reported
    assert text in fault
    fields = RAW_SIGNALS | {"counter": {"signals": ["NUMBER"]}}
    table = on_can(fields, dbc=table["dbc"], ids={"rate": 512, "acceleration": 512})
    text = "fields.counter.frame: expected one of rate, acceleration, which have the identifier"
    assert any(text in each for each in faults(table)), faults(table)


def test_first_bytes_and_pages_of_pages_select_the_frames_that_match_all(tmp_path: Path) -> None:
    """A frame must match the first bytes and all multiplexers of its signals."""
    pytest.importorskip("vqf")
    pytest.importorskip("cantools")
    (tmp_path / "pages.dbc").write_text(PAGES.format(page="0|4@1+"))
    table = on_can(
        RAW_SIGNALS | {"counter": {"signals": ["Q0"], "frame": "page"}},
        dbc=str(tmp_path / "pages.dbc"),
        ids={"page": 512, "rate": 512, "acceleration": 512},
        sequence=["page", "rate", "acceleration"],
        starts_with={"rate": "51 AA"},
        orientation="gateway",
    )
    table["fields"]["time"] = {"signals": ["TEMPERATURE"], "frame": "page", "unit": "s"}
    assert faults(table) == []
    settings = parse_rig(rig_of(table)).sources[1].settings
    assert isinstance(settings, CanTableSettings)
    page, rate, _ = (settings.multiplexers()[at] for at in range(3))
    assert page == Multiplexer(0xFF0F, frozenset({0x0703, 0x0803}))
    assert rate == Multiplexer(0xFFFF, frozenset({0xAA51}))

    table["starts_with"] = {"rate": "52 AA"}
    (fault,) = faults(table)
    assert "is not in the same frames as the rest of 'rate'" in fault
    assert "correct or remove `starts_with`" in fault


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ("300-301", "RAW.Q1 is present at PAGE = 300, but PAGE has 4 bits: correct the DBC file"),
        ("1-70000", "SG_MUL_VAL_ of Q1 has the range 1-70000, expected at most 1024 values"),
        ("1-" + "9" * 5000, "expected at most 1024 values: list the values"),
    ],
)
def test_values_that_a_multiplexer_cannot_have_are_named(
    tmp_path: Path, values: str, expected: str
) -> None:
    pytest.importorskip("cantools")
    text = PAGES.format(page="0|4@1+").replace("Q1 TEMPERATURE 9-9", f"Q1 PAGE {values}")
    (tmp_path / "pages.dbc").write_text(text.replace("Q1 m9 : 32|16", "Q1 m9 : 48|16"))
    table = on_can({"time": {"signals": ["Q1"], "unit": "s"}}, dbc=str(tmp_path / "pages.dbc"))
    assert any(expected in each for each in faults(table)), faults(table)


def test_pages_of_a_page_are_found_by_both_multiplexers(tmp_path: Path) -> None:
    """A nested multiplexer selects the content of a page again."""
    pytest.importorskip("cantools")
    (tmp_path / "pages.dbc").write_text(PAGES.format(page="0|4@1+"))
    q0, q1 = read_signals(str(tmp_path / "pages.dbc"), ["Q0", "Q1"])
    assert q0.multiplexer == Multiplexer(0xFF0F, frozenset({0x0703, 0x0803}))
    assert q1.multiplexer == Multiplexer(0xFF0F, frozenset({0x0903}))


def test_the_table_of_inertial_sense_decodes_a_message_as_its_documents_describe(
    example: Rig,
) -> None:
    q = (0.5, -0.5, 0.1, 0.7)
    content = struct.pack("<IdII4f3f3d", 2300, 123456.789, 0x11, 0, *q, *[0.0] * 6)
    message = b"\xef\x49\x04\x05" + struct.pack("<H", len(content)) + content
    a = b = 0
    for byte in message:  # as in the vendor's example program
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    other = b"\xef\x49\x04\x01\x00\x00\x3d\x9d"
    (sample,) = samples_of(example, "S1", other + message + bytes((a, b)))
    assert sample.q_native == pytest.approx(q, abs=1e-7)
    assert sample.q_world_sensor == pytest.approx(canonical(q, "NED"), abs=1e-6)
    assert sample.ticks == 123_456_789_000


def test_the_table_of_an_arduino_decodes_its_lines(example: Rig) -> None:
    (sample,) = samples_of(example, "S3", b"setup done\r\n1234,56,0.5,-0.5,0.1,0.7\r\n")
    assert (sample.ticks, sample.counter) == (1_234_000, 56)
    assert sample.q_native == (0.5, -0.5, 0.1, 0.7)


def documented_tables() -> list[str]:
    pages = [ROOT / "docs" / "devices" / f"{name}-table.md" for name in ("serial", "can")]
    return [
        body
        for page in pages
        for body in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    ]


@pytest.mark.parametrize("text", documented_tables(), ids=range(len(documented_tables())))
def test_every_documented_table_is_accepted(text: str, tmp_path: Path) -> None:
    if 'orientation = "gateway"' in text:
        pytest.importorskip("vqf")
    if "dbc = " in text:
        pytest.importorskip("cantools")
        signals = DBC.replace("TIME", "TIME_STAMP").split("BO_ 306")[0]
        (tmp_path / "sensor.dbc").write_text(signals)
    head = '[rig]\nname = "r"\n[chain]\njoints = ["hip", "knee", "ankle"]\n'
    head += 'segments = ["thigh", "shank"]\n'
    other = "shank" if 'segment = "thigh"' in text else "thigh"
    text += f'\n[[imu]]\nid = "S9"\nsegment = "{other}"\ndriver = "xbus"\nport = "/dev/ttyS9"\n'
    if "[can.can0]" not in text and 'can = "can0"' in text:
        text += '[can.can0]\nchannel = "can0"\n'
    (tmp_path / "rig.toml").write_text(head + text)
    assert len(load_rig(tmp_path / "rig.toml").sources) == 2


@pytest.mark.parametrize("name", ["serial-table", "can-table"])
def test_a_capture_without_a_table_is_refused_with_the_missing_key(name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}.fields: missing; place, scale and unit"):
        decoder_settings(find_driver(name), name, {})
