"""Loading of rig.toml: valid rigs, and reports of all faults."""

from __future__ import annotations

import contextlib
import tomllib
from copy import deepcopy
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jointfit_daemon.config import ConfigError, MqttSettings, load_rig, parse_rig, rig_schema
from jointfit_daemon.config._load import SECTIONS
from jointfit_daemon.driver import _SLCAN_BITRATES, CanBusSettings
from jointfit_daemon.model import AngleConvention
from jointfit_drivers.ports._python_can_bus import PythonCanBus
from jointfit_drivers.ports._slcan_bus import SlcanBus
from jointfit_protocols.can.slcan import BITRATES
from jointfit_simulators.scene import RigOptions

PROJECT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((PROJECT / "examples").glob("*.toml"))
Table = dict[str, Any]


def complaints(table: Table) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_rig(table)
    return [fault.text() for fault in caught.value.faults]


def test_valid_rig_is_converted_to_si(table: Table) -> None:
    table["chain"] |= {"side": "left", "lengths_m": {"shank": 0.4}, "distal": "foot"}
    table["chain"]["angles"] = {"knee": "tilt_torsion"}
    rig = parse_rig(table)
    assert rig.chain.sensors == (("S1", "S2"), ("S3", "S4"))
    assert rig.chain.left_side
    assert rig.chain.lengths == (None, 0.4)
    assert rig.chain.conventions == (None, AngleConvention.TILT_TORSION, None)
    assert [source.id for source in rig.sources] == ["S1", "S2", "S3", "S4", "mocap"]
    assert rig.mqtt.base == "jointfit/bench-1"
    assert rig.mqtt.tcp_port == 1883
    assert rig.calibration.markers == {"thigh": ("T1", "T2", "T3")}
    assert rig.recording is None
    assert rig.table == table


def test_procedure_of_the_patent_needs_its_regression_and_its_axes(table: Table) -> None:
    table["calibration"] = {"procedure": "patent", "method": "patent6"}
    table["chain"]["axes"] = "static"
    assert parse_rig(table).calibration.procedure == "patent"

    table["calibration"] = {"procedure": "patent"}
    del table["chain"]["axes"]
    assert complaints(table) == [
        'calibration.method = \'anchored\': expected "patent12" or "patent6" with procedure = '
        '"patent": the patent is a regression',
        'chain.axes = \'anatomical\': expected "static" with calibration.procedure = "patent": the '
        "patent defines every segment as unrotated in the static pose",
    ]


def test_bus_name_is_replaced_by_its_table(table: Table) -> None:
    assert parse_rig(table).sources[2].settings.can == CanBusSettings(channel="can0")


def test_equal_tables_give_equal_sources(table: Table) -> None:
    assert parse_rig(table).sources == parse_rig(deepcopy(table)).sources


def test_changed_bus_changes_its_sources_only(table: Table) -> None:
    before = parse_rig(table).sources
    table["can"]["can0"]["bitrate"] = 500_000
    after = parse_rig(table).sources
    assert [old == new for old, new in zip(before, after, strict=True)] == [
        True, True, False, False, True,
    ]  # fmt: skip


def test_parse_rig_copies_the_table(table: Table) -> None:
    given_table = deepcopy(table)
    rig = parse_rig(table)
    table["rig"]["name"] = "another"
    assert rig.table == given_table


TEN_MISTAKES = """
[rig]
name = "bench/1"
output_rate_hz = "fast"
aling_mode = "smooth"
[chain]
joints = ["hip", "knee"]
segments = ["thigh", "shank"]
[[imu]]
id = "S1"
segment = "tigh"
driver = "fkae"
port = "/dev/ttyUSB0"
[[imu]]
id = "S1"
segment = "shank"
driver = "fakecan"
can = "can1"
[can.can0]
channel = "can0"
[calibration]
method = "patent21"
[mqtt]
hots = "broker"
[mocap]
driver = "fakemocap"
markers.thigh = ["T1", "T1"]
"""


def test_ten_faults_are_reported_together(
    fakes: object, tmp_path: Path, subtests: pytest.Subtests
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(TEN_MISTAKES, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    text = str(caught.value)
    for line in (
        "rig.name = 'bench/1': must not contain /",
        "rig.output_rate_hz = 'fast': should be a valid number (limb states per second, Hz)",
        "rig.aling_mode = 'smooth': unknown key; known here: name, output_rate_hz, align_mode; "
        "did you mean 'align_mode'?",
        "chain.joints = ['hip', 'knee']: expected 3 joints, one more than segments",
        "imu.id = 'S1': named 2 times, expected once",
        "imu[S1].segment = 'tigh': unknown segment; known: thigh, shank; did you mean 'thigh'?",
        "imu[S1].driver = 'fkae': unknown driver; known: fake, fakecan; did you mean 'fake'?",
        "imu[S1].can = 'can1': no table [can.can1]; known: can0; did you mean 'can0'?",
        "imu: segment 'thigh' has no sensor",
        "calibration.method = 'patent21': expected 'anchored', 'patent12', 'patent6', 'markley', "
        "'mean' or 'single' (",
        "mqtt.hots = 'broker': unknown key",
        "did you mean 'host'?",
        "mocap.markers.thigh = ['T1', 'T1']: expected at least three different markers",
    ):
        with subtests.test(line):
            assert line in text


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        (("rig",), None, "[rig]: this table is missing"),
        (("rigg",), {}, "rigg: unknown table"),
        (("imu",), {}, "imu = {}: expected [[imu]] tables"),
        (("can",), 3, "can = 3: expected tables [can.NAME]"),
        (("mocap",), [], "mocap = []: expected a table"),
        (("imu", 0, "port"), None, "imu[S1].port: missing; name of the port"),
        (("imu", 0, "rate_hz"), "100", "imu[S1].rate_hz = '100': should be a valid number"),
        (("imu", 0, "id"), "mocap", "is reserved for the optical source"),
        (("imu", 0, "id"), "", "must not be empty"),
        (("imu", 0, "id"), "$S", "must not begin with $"),
        (
            ("imu", 0, "driver"),
            "fakemocap",
            "is a driver for motion capture; known here: fake, fakecan",
        ),
        (("mocap", "driver"), "fake", "is a driver for an IMU; known here: fakemocap"),
        (("mocap", "driver"), "fkemocap", "unknown driver; known: fakemocap; did you mean"),
        (("imu", 1, "port"), "/dev/nowhere-S1", "imu[S2].port = '/dev/nowhere-S1': is the port of"),
        (("imu", 3, "ids", "counter"), 0x21, "id 0x21 on this bus belongs to S3 (quaternion)"),
        (("imu", 2, "can"), None, "imu[S3].can: missing"),
        (("imu", 3, "ids", "quaternoin"), 5, "did you mean 'quaternion'?"),
        (("chain", "segments"), ["thigh", "thigh"], "named 2 times"),
        (("chain", "lengths_m"), {"shank": 420}, "expected a length in metres, below 3"),
        (
            ("chain", "origin_m"),
            [0.0, 0.0, 900.0],
            "expected a position in metres, closer than 100",
        ),
        (("chain", "angles"), {"kne": "trunk"}, "did you mean 'knee'?"),
        (
            ("chain", "angles"),
            {"hip": "flexion"},
            "unknown joint between two segments; known: knee",
        ),
        (
            ("chain", "angles"),
            {"knee": "euler"},
            "should be 'flexion', 'elevation', 'tilt_torsion'",
        ),
        (("chain", "proximal"), "shank", "is already a segment"),
        (("mocap", "markers", "shak"), ["A", "B", "C"], "did you mean 'shank'?"),
        (("mocap", "markers", "shank"), ["T1", "B", "C"], "is a marker of 'thigh' already"),
        (("mocap", "rigid_body"), {"thigh": "Thigh"}, "has markers already"),
        (("mqtt",), {"base": "a//b"}, "mqtt.base = 'a//b': must not be empty"),
        (("mqtt",), {"base": "a/#"}, "must not contain #"),
        (("mqtt",), {"version": "3"}, "expected '5' or '3.1.1'"),
        (("calibration",), {"store": "../elsewhere"}, "plain name of one folder"),
    ],
)
def test_fault_names_key_value_and_expectation(
    table: Table, where: tuple[Any, ...], value: object, said: str
) -> None:
    part: Any = table
    for step in where[:-1]:
        part = part[step]
    if value is None:
        del part[where[-1]]
    else:
        part[where[-1]] = value
    assert any(said in line for line in complaints(table)), complaints(table)


@pytest.mark.parametrize(
    ("calibration", "said"),
    [
        ({"center_method": "spere"}, "expected 'sphere', 'score', 'sara', 'geometric', "),
        ({"center_method": "spere"}, "did you mean 'sphere'?"),
        ({"joint_center_methods": {"knee": "halvorsen"}}, "calibration.joint_center_methods.knee"),
        (
            {"joint_center_methods": {"kene": "sara"}},
            "calibration.joint_center_methods.kene = 'kene': unknown joint; known: hip, knee, ankle"
            "; did you mean 'knee'?",
        ),
        (
            {"joint_center_methods": {"knee": "sara"}},
            "calibration.joint_center_methods.knee = 'sara': needs markers on both sides of the "
            "joint: add mocap.markers.shank",
        ),
        (
            {"joint_center_methods": {"hip": "score"}},
            "calibration.joint_center_methods.hip = 'score': needs markers on both sides of the "
            "joint: add chain.proximal and its markers",
        ),
    ],
)
def test_an_estimator_that_the_rig_cannot_serve_is_a_fault(
    table: Table, calibration: Table, said: str
) -> None:
    table["calibration"] = calibration
    assert any(said in line for line in complaints(table)), complaints(table)


def test_estimators_of_joint_centers_need_cameras(table: Table) -> None:
    table["calibration"] = {"center_method": "oriented"}
    assert parse_rig(table).calibration.center_method_of("knee") == "oriented"
    table["calibration"] = {"center_method": "score", "joint_center_methods": {"knee": "sara"}}
    table["mocap"]["markers"]["shank"] = ["C1", "C2", "C3"]
    settings = parse_rig(table).calibration
    assert [settings.center_method_of(joint) for joint in ("hip", "knee")] == ["score", "sara"]

    del table["mocap"]
    (line,) = complaints(table)
    assert line.startswith("calibration.center_method: joint centers need cameras: add [mocap]")


def test_links_to_one_port_are_the_same_port(table: Table, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("/dev/nowhere-S1")
    table["imu"][1]["port"] = str(tmp_path / "link")
    assert any("is the port of imu[S1] already" in line for line in complaints(table))


def test_a_password_is_directed_to_its_file(table: Table) -> None:
    table["mqtt"] = {"password": "hunter2"}
    (line,) = complaints(table)
    assert line.endswith("name it: password_file")
    assert "hunter2" not in line


def test_unknown_driver_causes_one_fault(table: Table) -> None:
    table["imu"][0]["driver"] = "fkae"
    assert len(complaints(table)) == 1


def test_broken_driver_is_a_fault_of_its_users_only(
    table: Table, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("tests.fake_drivers").fake_drivers.NAMES, "bad", "No")
    parse_rig(table)
    table["imu"][0]["driver"] = "bad"
    (said,) = complaints(table)
    assert "imu[S1].driver = 'bad': cannot be loaded (AttributeError" in said
    assert "install it again" in said


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[rig\nname = 1", "line 1"),
        (b"\xff\xfe", "is not UTF-8"),
        ("[rig]".encode("utf-16"), "iconv -f UTF-16 -t UTF-8 rig.toml > converted-rig.toml"),
        (None, "no such file: check the path, or write one: `jointfit init`"),
    ],
)
def test_syntax_error_names_its_line(tmp_path: Path, content: bytes | None, said: str) -> None:
    path = tmp_path / "rig.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=said):
        load_rig(path)


def test_file_names_are_relative_to_the_rig_file(
    table: Table, tmp_path: Path, fakes: object
) -> None:
    text = TEN_MISTAKES.partition("[mqtt]")[0].replace("fkae", "fake").replace("tigh", "thigh")
    text = text.replace("bench/1", "b").replace('"fast"', "50").replace("aling", "align")
    text = text.replace('"hip", ', '"hip", "ankle", ').replace('= "S1"', '= "S2"', 1)
    text = text.replace("can.can0", "can.can1").replace("patent21", "patent12")
    path = tmp_path / "rig.toml"
    path.write_text(text + '[mqtt]\npassword_file = "secret"\ntls.ca = "/etc/ca.pem"\n')
    mqtt = load_rig(path).mqtt
    assert mqtt.password_file == str(tmp_path / "secret")
    assert mqtt.tls is not None
    assert mqtt.tls.ca == "/etc/ca.pem"
    assert mqtt.tcp_port == 8883


def test_default_broker_is_an_address() -> None:
    example = tomllib.loads((PROJECT / "examples" / "knee.toml").read_text(encoding="utf-8"))
    for host in (MqttSettings().host, RigOptions().mqtt_host, example["mqtt"]["host"]):
        assert ip_address(host).is_loopback  # /etc/hosts may not contain "localhost"


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(data=st.data())
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_table_raises_config_error_at_most(table: Table, data: st.DataObject) -> None:
    broken = deepcopy(table)
    section = data.draw(st.sampled_from(sorted(broken)))
    part = broken[section]
    if isinstance(part, list):
        part = data.draw(st.sampled_from(part))
    if data.draw(st.booleans()):
        broken[section] = data.draw(anything)
    else:
        part[data.draw(st.sampled_from(sorted(part)) | st.text(max_size=5))] = data.draw(anything)
    with contextlib.suppress(ConfigError):
        parse_rig(broken)


def test_the_schema_describes_every_key() -> None:
    schema = rig_schema()
    for name, model in schema["$defs"].items():
        for key, field in model.get("properties", {}).items():
            assert field.get("description") or "$ref" in field, f"{name}.{key}"
    assert set(schema["properties"]) == set(SECTIONS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_the_schema_accepts_every_example(path: Path) -> None:
    jsonschema.validate(tomllib.loads(path.read_text("utf-8")), rig_schema())


def test_the_schema_accepts_metrics_and_lsl() -> None:
    rig = tomllib.loads(EXAMPLES[0].read_text("utf-8")) | {"metrics": {}, "lsl": {}}
    jsonschema.validate(rig, rig_schema())


def test_in_the_schema_a_bus_is_a_name(fakes: object) -> None:
    can = rig_schema()["$defs"]["FakeCanSettings"]["properties"]["can"]
    assert can["type"] == "string"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a = " + b"[" * 5000, "nested more than 32 levels deep"),
        (b'[rig]\nname = "a\\u0000b"', "rig.name = 'a\\x00b': must not contain a NUL"),
        (b"[rig]\noutput_rate_hz = 1" + b"0" * 5000, "TOML"),
        (b"\xff\xfe[\0", "is not UTF-8: found UTF-16"),
        (b"# " * 200_000, "larger than"),
        (b"[rig]\nname 'x'\noutput_rate_hz = 99,5\n", "line 3 = 'output_rate_hz = 99,5': "),
        (b"[rig]\noutput_rate_hz = 99,5\n", "use a decimal point, not a comma"),
    ],
)
def test_hostile_text_is_one_fault(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    assert said in str(caught.value)


def test_syntax_errors_and_wrong_values_are_reported_together(
    fakes: object, tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(
        "[rig]\nname = bench\noutput_rate_hz = 'fast'\n[chain]\njoints = ['hip', 'knee']\n"
        "segments = ['thigh']\nside = 'lefft'\n[mqtt]\nhost = broker\n"
    )
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    keys = [fault.key for fault in caught.value.faults]
    assert keys == ["line 2", "line 9", "rig.output_rate_hz", "chain.side", "imu"]


FIFTEEN_MISTAKES = """
[rig]
name = "bench/1"
output_rate_hz = "fast"
[chain]
joints = ["hip", "knee"]
segments = ["thigh", "shank"]
side = "middle"
lengths_m = { shnak = 0.4 }
[[imu]]
id = "S1"
segment = "tigh"
driver = "fake"
port = "/dev/a"
rate_hz = "fast"
[[imu]]
id = "S2"
segment = "shank"
driver = "fake"
port = "/dev/a"
silence_s = inf
[[imu]]
id = "S3"
segment = "shank"
driver = "fakecan"
can = "can0"
rate_hz = -1
[[imu]]
id = "S4"
segment = "shank"
driver = "fakecan"
can = "can0"
[can.can0]
channel = "can0"
[calibration]
store = "../elsewhere"
method = "patent21"
[mqtt]
base = "a//b"
port = 99999
[mocap]
driver = "fakemocap"
up_axis = "w"
markers.thigh = ["T1", "T1"]
markers.thihg = ["T2", "T3", "T4"]
"""


def test_one_pass_finds_faults_in_and_across_tables(fakes: object, tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(FIFTEEN_MISTAKES, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    text = str(caught.value)
    for line in (
        "rig.name = 'bench/1': must not contain /",
        "rig.output_rate_hz = 'fast'",
        "chain.joints = ['hip', 'knee']: expected 3 joints",
        "chain.side = 'middle'",
        "chain.lengths_m.shnak = 'shnak': unknown segment",
        "imu[S1].segment = 'tigh': unknown segment",
        "imu: segment 'thigh' has no sensor",
        "imu[S1].rate_hz = 'fast'",
        "imu[S2].port = '/dev/a': is the port of imu[S1] already",
        "imu[S2].silence_s = inf",
        "imu[S3].rate_hz = -1",
        "imu[S4].ids.quaternion: id 0x21 on this bus belongs to S3",
        "calibration.store = '../elsewhere': must be the plain name",
        "calibration.method = 'patent21'",
        "mqtt.base = 'a//b': must not be empty",
        "mqtt.port = 99999",
        "mocap.up_axis = 'w'",
        "mocap.markers.thigh = ['T1', 'T1']: expected at least three",
    ):
        assert line in text
    (part,) = [fault for fault in caught.value.faults if fault.key == "mocap.markers.thihg"]
    assert part.near != "thigh"


def real_rig(**changed: Any) -> Table:
    """Return a rig with drivers of the project: one IMU on a UART, and two on CAN."""
    xbus = {"id": "S1", "segment": "thigh", "driver": "xbus", "port": "/dev/ttyUSB0"}
    xcdi = {"segment": "shank", "driver": "xcdi", "can": "can0"}
    ids = {"sample_time": 0x105, "group_counter": 0x106, "quaternion": 0x121}
    return {
        "rig": {"name": "bench"},
        "chain": {"joints": ["hip", "knee", "ankle"], "segments": ["thigh", "shank"]},
        "imu": [
            xbus | changed.get("xbus", {}),
            xcdi | {"id": "S3"} | changed.get("xcdi", {}),
            xcdi | {"id": "S4", "ids": ids} | changed.get("xcdi", {}),
        ],
        "can": {"can0": {"channel": "can0"} | changed.get("can", {})},
    }


@pytest.mark.parametrize(
    ("base", "line"),
    [
        (0x0C, "imu[S4].ids.sample_time: id 0x11 on this bus belongs to S3 (status_word derived "
         "from its other ids); expected a unique id"),
        (0x05, "imu[S4].ids.error: id 0x6 on this bus belongs to S3 (group_counter); expected a "
         "unique id. It is derived from its other ids: set it to an unused one"),
    ],
)  # fmt: skip
def test_identifiers_derived_for_a_sensor_must_not_belong_to_another(base: int, line: str) -> None:
    table = real_rig()
    ids = {"sample_time": 0x05, "group_counter": 0x06, "quaternion": 0x21}
    table["imu"][1]["ids"] = ids
    table["imu"][2]["ids"] = {name: number + base for name, number in ids.items()}
    assert complaints(table) == [line]


def test_an_11_bit_and_a_29_bit_identifier_of_one_number_are_different() -> None:
    table = real_rig()
    del table["imu"][2]["ids"]
    table["imu"][2]["extended_ids"] = True
    assert len(parse_rig(table).sources) == 3


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"xbus": {"baud": 9600}},
         "imu[S1].baud = 9600: 100 Hz need 36000 bit/s, the line carries 9600: set baud = 38400 or "
         "more here and on the device, or set rate_hz = 26 or less"),
        ({"xbus": {"baud": 300}},
         "the line carries 300: set baud = 38400 or more here and on the device"),
        ({"xbus": {"baud": 10**12}}, "imu[S1].baud"),
        ({"xbus": {"port": ""}}, "imu[S1].port = '': must not be empty"),
        ({"can": {"channel": "/dev/ttyACM0"}}, 'a serial adapter needs interface = "slcan"'),
        ({"can": {"channel": "a" * 16}}, "up to 15 bytes without slash or space"),
        ({"can": {"channel": "can 0"}}, "expected the name of a network interface"),
        ({"can": {"channel": ""}}, "can.can0.channel = '': must not be empty"),
        ({"can": {"interface": "slcan", "bitrate": 123_456}},
         "not a bit rate of SLCAN: expected one of 1"),
        ({"can": {"interface": "socketcn"}}, "did you mean 'socketcan'?"),
        ({"can": {"bitrate": 125_000}, "xcdi": {"rate_hz": 400}},
         "can.can0.bitrate = 125000: S3, S4 need up to 244000 bit/s, but the bus carries only "
         "125000: set bitrate = 250000"),
        ({"can": {"interface": "slcan", "transport": "uart"}, "xcdi": {"rate_hz": 200}},
         "can.can0.baud = 115200: S3, S4 need 184000 bit/s on the adapter's serial line"),
    ],
)  # fmt: skip
def test_insufficient_bit_rates_and_invalid_interface_names_are_refused(
    changed: dict[str, Any], said: str
) -> None:
    assert any(said in line for line in complaints(real_rig(**changed))), complaints(
        real_rig(**changed)
    )


@pytest.mark.parametrize("channel", ["", "can 0", 3, None])
def test_the_load_of_a_bus_is_checked_although_its_channel_is_wrong(channel: object) -> None:
    rig = real_rig(can={"channel": channel, "bitrate": 125_000}, xcdi={"rate_hz": 400})
    found = complaints(rig)
    assert [line.split()[0].rstrip(":") for line in found] == [
        "can.can0.channel",
        "can.can0.bitrate",
    ]


def test_identifiers_on_two_buses_with_wrong_channels_are_not_compared() -> None:
    rig = real_rig()
    rig["can"] = {"can0": {"channel": ""}, "can1": {"channel": ""}}
    rig["imu"][2] = rig["imu"][1] | {"id": "S4", "can": "can1"}
    found = complaints(rig)
    assert [line.split()[0] for line in found] == ["can.can0.channel", "can.can1.channel"]


def test_sufficient_bit_rates_are_accepted() -> None:
    parse_rig(real_rig())
    parse_rig(real_rig(xbus={"baud": 9600, "rate_hz": 26}))
    parse_rig(real_rig(xbus={"baud": 9600, "transport": "usb"}))
    parse_rig(real_rig(can={"bitrate": 500_000}, xcdi={"rate_hz": 400}))


def test_slcan_bit_rates_equal_those_of_the_codec() -> None:
    assert _SLCAN_BITRATES == BITRATES


@given(
    xbus=st.fixed_dictionaries(
        {},
        optional={
            "baud": st.integers(-1, 10**7) | st.sampled_from([9600, 115_200, 921_600]),
            "rate_hz": st.integers(0, 500) | st.floats(0.1, 400),
            "transport": st.sampled_from(["uart", "usb"]),
            "port": st.text(max_size=20),
        },
    ),
    can=st.fixed_dictionaries(
        {},
        optional={
            "interface": st.sampled_from(["socketcan", "slcan", "virtual", "pcan"]),
            "channel": st.text(max_size=18) | st.just("can0"),
            "bitrate": st.integers(0, 2_000_000) | st.sampled_from([125_000, 500_000]),
            "baud": st.integers(0, 10**7),
        },
    ),
    rate_hz=st.integers(1, 2000),
)
def test_drivers_accept_checked_buses(
    xbus: dict[str, Any], can: dict[str, Any], rate_hz: int
) -> None:
    try:
        rig = parse_rig(real_rig(xbus=xbus, can=can, xcdi={"rate_hz": rate_hz}))
    except ConfigError:
        return
    for source in rig.sources:
        source.driver_class(source.settings).decoder()
    bus = rig.sources[1].settings.can
    (SlcanBus if bus.interface == "slcan" else PythonCanBus)(bus)
    assert bus.interface != "slcan" or bus.bitrate in BITRATES
    assert bus.interface != "socketcan" or len(bus.channel.encode()) < 16
