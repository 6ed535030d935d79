"""The engine of `jointfit init`: every dialogue yields the rig that its answers describe."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.tools.init import _engine
from jointfit_daemon.tools.init._answer_file import read_answers, write_answers
from jointfit_daemon.tools.init._answers import sensors_of, split_address
from jointfit_daemon.tools.init._engine import accept, complete, next_question, rig_faults
from jointfit_daemon.tools.init._limbs import LIMBS
from jointfit_daemon.tools.init._parsing import AnswerError
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._rig_text import rig_text
from tests.tools.init.dialogues import (
    DEVICES,
    NAMES,
    NOTHING,
    STREAM,
    answers_to,
    completed,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.init._answers import Answers
    from jointfit_daemon.tools.init._engine import Asked
    from jointfit_daemon.tools.init._found import Found

FOUND = st.sampled_from([NOTHING, DEVICES, STREAM])
RANDOM = settings(
    max_examples=5,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # shrinking a dialogue takes minutes
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def rig_of(answers: Answers, found: Found) -> Rig:
    """Return the rig that `jointfit check` reads from the text."""
    return parse_rig(tomllib.loads(rig_text(rig_table(answers, found))))


def random_answers(data: st.DataObject, found: Found) -> Answers:
    def choose(asked: Asked) -> Any:
        return data.draw(answers_to(asked)) if data.draw(st.booleans()) else asked.default

    return completed(found, choose)


def assert_means(rig: Rig, answers: Answers) -> None:
    """Assert that each key of a rig corresponds to the answers."""
    limb = LIMBS[answers["limb", ""]]
    assert rig.name == answers["name", ""]
    assert rig.output_rate_hz == answers["output_rate_hz", ""]
    assert rig.calibration_store == answers["subject", ""]
    assert rig.chain.segments == limb.segments
    assert rig.chain.planar == limb.is_planar
    assert rig.chain.left_side == (answers.get(("side", "")) == "left")

    imus = {source.id: source for source in rig.sources if source.kind == "imu"}
    assert {name: source.segment for name, source in imus.items()} == sensors_of(answers)
    for name, source in imus.items():
        device = answers["device", name]
        bus = getattr(source.settings, "can", None)
        assert device == (source.settings.port if bus is None else bus.channel)
        assert source.rate_hz == answers["sensor_rate_hz", ""]
        if bus is None:
            assert source.settings.baud == answers["baud", name]
        else:
            ids = source.settings.ids
            assert (ids.sample_time, ids.group_counter, ids.quaternion) == answers["ids", name]
        if bus is not None and device in answers["can_adapters", ""]:
            assert (bus.interface, bus.bitrate) == ("slcan", answers["bitrate", device])

    cameras = [source for source in rig.sources if source.kind == "mocap"]
    assert bool(cameras) == (limb.is_planar or answers[("cameras", "")])
    for source in cameras:
        host, port = split_address(answers["server", ""])
        assert (source.settings.server, source.settings.command_port) == (host, port or 1510)
        marked = {part: names for (key, part), names in answers.items() if key == "markers"}
        assert source.settings.markers == {part: names for part, names in marked.items() if names}

        assert source.settings.up_axis == answers["up_axis", ""]
        assert source.settings.plate == answers.get(("plate", ""))
    lengths = {part: length for (key, part), length in answers.items() if key == "length_m"}
    assert rig.chain.lengths == tuple(lengths.get(segment) for segment in limb.segments)

    host, port = split_address(answers["broker", ""])
    assert rig.mqtt.host == host
    assert rig.mqtt.port == port
    assert rig.mqtt.username == answers["username", ""]
    assert rig.mqtt.password_file == answers.get(("password_file", ""))
    encryption = answers.get(("encryption", ""))
    assert rig.mqtt.insecure == (encryption == "none")
    assert (rig.mqtt.tls is not None) == (encryption in ("tls", "own-ca"))
    if rig.mqtt.tls is not None:
        assert rig.mqtt.tls.ca == answers.get(("ca", ""))


@RANDOM
@given(st.data(), FOUND)
def test_every_completed_dialogue_yields_a_valid_rig_with_its_meaning(
    data: st.DataObject, found: Found
) -> None:
    answers = random_answers(data, found)
    assert_means(rig_of(answers, found), answers)


UNUSUAL = {
    "name": "rig 7", "side": "left", "subject": "p-2", "output_rate_hz": "50",
    "sensor_rate_hz": "200", "can_adapters": "/dev/ttyACM0", "bitrate": "500000",
    "baud": "460800", "cameras": "yes", "server": "10.0.0.5:1600", "up_axis": "z",
    "plate": "Board", "length_m": "0.37", "broker": "lab-pc:1884", "ca": "lab.pem",
    "username": "gw", "password_file": "pw",
}  # fmt: skip
"""An answer to every question, different from its proposal."""


@pytest.mark.parametrize("cameras", ["yes", "no"])
@pytest.mark.parametrize(
    ("limb", "encryption"),
    [
        ("knee", "none"),
        ("legs", "tls"),
        ("arm", "own-ca"),
        ("trunk", "none"),
        ("planar", "tls"),
    ],
)
def test_every_answer_that_differs_from_its_proposal_is_in_the_rig(
    monkeypatch: pytest.MonkeyPatch, limb: str, encryption: str, cameras: str
) -> None:
    monkeypatch.setattr(_engine, "rig_faults", lambda *_: set())  # the test checks the complete rig
    chosen = UNUSUAL | {"limb": limb, "encryption": encryption, "cameras": cameras}
    answers: Answers = {}
    while (asked := next_question(answers, NOTHING)) is not None:
        number = len(answers)
        own = {
            "device": (f"/dev/ttyUSB{number}", "/dev/ttyACM0", "can3")[number % 3],
            "ids": [number << 8, number << 8 | 1, number << 8 | 2],
            "sensors": f"{asked.subject}.a, {asked.subject}.b, {asked.subject}.c",
            "markers": ", ".join(f"{asked.subject}:{k}" for k in range(3)),
        }
        answers = accept(asked, (chosen | own)[asked.question.key], answers, NOTHING)
    rig = rig_of(answers, NOTHING)
    assert_means(rig, answers)
    assert rig.chain.left_side == (limb in ("knee", "arm", "planar"))
    assert (rig.mqtt.port, rig.mqtt.insecure) == (1884, encryption == "none")
    for source in rig.sources:
        if source.kind == "mocap":
            assert (source.settings.command_port, source.settings.up_axis) == (1600, "z")


class _Given:
    """Answers from a file, and typed answers to the other questions."""

    def __init__(self, stored: Answers, typed: Answers) -> None:
        self._answers = {**typed, **stored}

    def __call__(self, asked: Asked) -> Any:
        return self._answers[asked.key]


@RANDOM
@given(st.data(), FOUND)
def test_a_dialogue_interrupted_at_any_question_resumes_to_the_same_rig(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: st.DataObject, found: Found
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(_engine, "rig_faults", lambda *_: set())  # other tests check `rig_faults`
        whole = random_answers(data, found)
        text = rig_text(rig_table(whole, found))
        state = tmp_path / "rig.answers.toml"
        for kept in range(len(whole) + 1):
            write_answers(state, dict(list(whole.items())[:kept]))
            stored = read_answers(state)
            assert {*stored} == {*[*whole][:kept]}
            resumed = completed(found, _Given(stored, whole))
            assert rig_text(rig_table(resumed, found)) == text


def test_two_sensors_on_a_bus_get_the_identifiers_that_were_received_one_after_the_other() -> None:
    asked, answers = until("ids", STREAM, device="can0")
    assert asked.default == (0x105, 0x106, 0x121)
    answers = accept(asked, None, answers, STREAM)
    device = next_question(answers, STREAM)
    assert device is not None
    answers = accept(device, "can0", answers, STREAM)
    second = next_question(answers, STREAM)
    assert second is not None
    assert second.default == (0x205, 0x206, 0x221)


@pytest.mark.parametrize("limb", sorted(LIMBS))
@pytest.mark.parametrize("found", [NOTHING, DEVICES, STREAM], ids=["nothing", "devices", "stream"])
def test_the_proposals_of_every_limb_are_valid(limb: str, found: Found) -> None:
    answers = {("name", ""): "rig", ("limb", ""): limb}
    assert rig_faults(answers, found) == set()
    assert rig_of(complete(answers, found), found).chain.segments == LIMBS[limb].segments


@RANDOM
@given(NAMES)
def test_a_name_is_accepted_exactly_if_the_check_accepts_it(name: str) -> None:
    asked = next_question({}, NOTHING)
    assert asked is not None
    table = rig_table(complete({}, NOTHING), NOTHING)
    table["rig"]["name"] = name.strip()
    try:
        parse_rig(table)
    except Exception:  # noqa: BLE001 - any refusal
        with pytest.raises(AnswerError):
            accept(asked, name, {}, NOTHING)
    else:
        assert accept(asked, name, {}, NOTHING)["name", ""] == name.strip()


def until(key: str, found: Found, **given: Any) -> tuple[Asked, Answers]:
    """Return the first question with `key`, and the answers before it."""
    answers: Answers = {}
    while (asked := next_question(answers, found)) is not None and asked.question.key != key:
        value = given.get(asked.question.key, asked.default)
        if value is None and not asked.optional:
            value = asked.question.stand_in(answers, found, asked.subject)
        answers = accept(asked, value, answers, found)
    assert asked is not None
    return asked, answers


@pytest.mark.parametrize(
    ("key", "given_text", "words"),
    [
        ("limb", "knie", "did you mean 'knee'"),
        ("limb", "9", "the list has 5 entries"),
        ("output_rate_hz", "fast", "expected a number"),
        ("output_rate_hz", "nan", "expected a number"),
        ("output_rate_hz", "5000", "output_rate_hz"),
        ("sensor_rate_hz", "99.5", "whole Hz"),
        ("sensors", "a,,b", "empty name"),
        ("sensors", "a, a", "name twice"),
        ("sensors", "mocap", "reserved"),
        ("sensors", "", "an answer is needed"),
        ("subject", "../x", "plain name of one folder"),
        ("device", "ttyUSB0", "/dev/ttyUSB0"),
        ("device", "can0/1\0", "NUL"),
        ("baud", "9600", "bit/s"),
        ("broker", "host:99999", "expected a number from 1 to 65535"),
        ("broker", "a b", "without spaces"),
        ("name", {"a": 1}, "expected one value"),
        ("name", "\udcff", "UTF-8"),
    ],
)
def test_an_unusable_answer_is_refused_with_the_expected_one(
    key: str, given_text: str, words: str
) -> None:
    asked, answers = until(key, NOTHING)
    with pytest.raises(AnswerError) as refused:
        accept(asked, given_text, answers, NOTHING)
    assert words in str(refused.value)


def test_a_port_serves_one_sensor_and_leaves_the_list() -> None:
    asked, answers = until("device", DEVICES)
    answers = accept(asked, "1", answers, DEVICES)
    assert answers["device", "thigh-front"] == "/dev/ttyUSB0"
    baud = next_question(answers, DEVICES)
    assert baud is not None
    answers = accept(baud, None, answers, DEVICES)

    second = next_question(answers, DEVICES)
    assert second is not None
    assert [each.address for each in second.choices] == ["/dev/ttyUSB1", "/dev/ttyUSB2", "can0"]
    with pytest.raises(AnswerError, match=r"is the port of imu\[thigh-front\] already"):
        accept(second, "/dev/ttyUSB0", answers, DEVICES)


def test_a_can_adapter_that_was_typed_is_in_the_list() -> None:
    asked, _ = until("device", NOTHING, can_adapters="/dev/ttyACM7")
    assert [(each.address, each.text) for each in asked.choices] == [
        ("/dev/ttyACM7", "CAN adapter")
    ]


def test_markers_of_the_stream_are_proposed_for_the_part_they_are_named_after() -> None:
    asked, answers = until("markers", STREAM, limb="knee", cameras=True)
    proposed = {}
    while asked.question.key == "markers":
        proposed[asked.subject] = asked.default
        answers = accept(asked, asked.default, answers, STREAM)
        following = next_question(answers, STREAM)
        assert following is not None
        asked = following
    assert proposed["thigh"] == ("T1", "T2", "T3", "T4")
    assert proposed["shank"] == ("C1", "C2", "C3", "C4")
    assert proposed["foot"] == ("Foot_1", "Foot_2", "Foot_3", "Foot_4")
    assert asked.default == "calibration plate"
