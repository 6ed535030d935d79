"""Any request gives a reply of limited size, and raises no exception."""

from __future__ import annotations

import json
import math
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import Incoming
from jointfit_daemon.outputs.payloads._encoding import encode
from jointfit_daemon.pipeline.events import Reply, Request
from jointfit_daemon.supervisor.requests import (
    RequestAuthenticator,
    parse_request,
)
from jointfit_daemon.supervisor.requests._validation import _reply_address


def incoming(payload: bytes, command: str = "calibrate", **more: Any) -> Incoming:
    return Incoming(f"b/bridge/request/{command}", payload, retained=False, **more)


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"{", "is not JSON"),
        (b"[]", "expected a JSON object"),
        (b'{"phase":"stand"}', "expected 'align', 'static', 'functional', 'abort' or 'revert'"),
        (b'{"phase":"static","seconds":-1}', "should be greater than 0"),
        (b'{"phase":"static","force":"yes"}', "should be a valid boolean"),
        (b'{"phase":"static","transaction":7}', "should be a valid string"),
        (b'"' + bytes(20_000) + b'"', "20002 bytes, expected at most 4096"),
        (b"[" * 4000, "more than 64 brackets"),
        (b"\xff", "is not JSON"),
    ],
)
def test_faulty_request_is_refused_with_its_faults(payload: bytes, said: str) -> None:
    reply = parse_request(incoming(payload))
    assert isinstance(reply, Reply)
    assert reply.error is not None
    assert said in str(reply.error["message"])


ANSWERS = "b/bridge/response"


@pytest.mark.parametrize(
    ("topic", "usable"),
    [
        (f"{ANSWERS}/calibrate", True),
        (f"{ANSWERS}/calibrate/my-client.1/7", True),
        ("my/topic", False),
        ("b/pose", False),
        ("b/bridge/responses", False),
        (ANSWERS, False),
        (f"{ANSWERS}/", False),
        (f"{ANSWERS}/#", False),
        (f"{ANSWERS}/+/a", False),
        (f"{ANSWERS}//a", False),
        (f"{ANSWERS}/a\n", False),
        (f"{ANSWERS}/a\0", False),
        (f"{ANSWERS}/\x9b", False),
        (f"{ANSWERS}/" + "/".join("a" * 301), False),
        (f"{ANSWERS}/" + "a" * 65, False),
        (f"c/{ANSWERS}/a", False),
        ("$SYS/x", False),
        ("", False),
    ],
)
def test_reply_topic_must_be_below_the_response_topic(topic: str, usable: bool) -> None:
    asked = incoming(b'{"phase":"static"}', response_topic=topic)
    assert (_reply_address(asked).topic == topic) is usable
    found = parse_request(asked)
    assert isinstance(found, Request) is usable
    if isinstance(found, Reply):
        assert found.error is not None
        assert found.error["key"] == "response_topic"


def test_correlation_data_over_the_limit_is_refused_and_not_sent_back() -> None:
    asked = incoming(b'{"phase":"static"}', correlation=bytes(257))
    found = parse_request(asked)
    assert isinstance(found, Reply)
    assert found.error is not None
    assert "257 bytes, expected at most 256" in str(found.error["message"])
    assert _reply_address(asked).correlation is None
    assert _reply_address(incoming(b"{}", correlation=bytes(256))).correlation == bytes(256)


@pytest.mark.parametrize("command", ["", "x" * 33, "a b", "a\nb", "caf\xe9", "\x9b2J", "a\0"])
def test_a_topic_that_cannot_be_a_command_gets_no_answer(command: str) -> None:
    assert parse_request(incoming(b"{}", command)) is None


deep = st.integers(1, 4000).flatmap(
    lambda depth: st.sampled_from(
        [
            b"[" * depth + b"]" * depth,
            b"[" * depth,
            b'{"a":' * depth + b"1" + b"}" * depth,
            b'{"phase":' + b"[" * depth + b"]" * depth + b"}",
        ]
    )
)
odd_values = st.sampled_from(
    [
        *("1e999", "-0", "-0.0", "5e-324", "NaN", "Infinity", "60", "0.5", str(2**70)),
        *("null", "[]", "{}", '"\\ud800"', '"\\u0000"', '"static"', "true"),
    ]
)
odd_tables = st.lists(
    st.tuples(
        st.sampled_from(["phase", "seconds", "force", "transaction", "t_us", "x"]), odd_values
    )
).map(lambda pairs: ("{" + ",".join(f'"{k}":{v}' for k, v in pairs) + "}").encode())
many_keys = st.integers(1, 1500).map(
    lambda count: json.dumps({f"k{number}": number for number in range(count)}).encode()
)


@given(st.binary(max_size=6000) | deep | odd_tables | many_keys)
def test_any_payload_gives_a_request_or_a_limited_reply(payload: bytes) -> None:
    for guard in (None, RequestAuthenticator(MqttSettings())):
        found = parse_request(incoming(payload), guard)
        assert found is not None
        if isinstance(found, Reply):
            assert len(encode({"transaction": found.transaction, "error": found.error})) < 16_384
        else:
            assert math.isfinite(cast("float", found.arguments.get("seconds", 1.0)))
