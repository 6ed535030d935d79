"""Signed requests: verification, refusals, and signing in a shell."""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import (
    SIGNATURE_LIFETIME_US,
    Incoming,
    SignatureRejectedError,
    verify,
)
from jointfit_daemon.outputs.mqtt._signature import canonical, sign_request, signature_of
from jointfit_daemon.pipeline.events import Reply, Request
from jointfit_daemon.supervisor.requests import RequestAuthenticator, parse_request

if TYPE_CHECKING:
    from collections.abc import Callable

TOPIC = "jointfit/bench-1/bridge/request/calibrate"
KEY = b"0123456789abcdef0123456789abcdef"
ASKED = {"phase": "static", "transaction": "a1"}
PAGE = Path(__file__).resolve().parents[3] / "docs" / "mqtt.md"

requests = st.dictionaries(
    st.sampled_from(["phase", "seconds", "transaction", "force"]),
    st.text(max_size=8) | st.integers(-9, 9) | st.booleans() | st.none(),
)


@pytest.fixture
def guard(tmp_path: Path) -> RequestAuthenticator:
    (tmp_path / "key").write_bytes(KEY + b"\n")
    return RequestAuthenticator(MqttSettings(request_key_file=str(tmp_path / "key")))


def now_us() -> int:
    return time.time_ns() // 1000


@given(requests)
def test_signed_request_is_verified(request: dict[str, Any]) -> None:
    sent = orjson.loads(orjson.dumps(sign_request(KEY, TOPIC, request)))
    nonce, t_us = verify(KEY, TOPIC, sent, now_us())
    assert (nonce, t_us) == (sent["nonce"], sent["t_us"])


@given(requests)
def test_the_signature_is_plain_hmac_sha256_of_topic_and_sorted_json(
    request: dict[str, Any],
) -> None:
    text = json.dumps(request, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    expected = hmac.new(KEY, f"{TOPIC}\n{text}".encode(), hashlib.sha256).hexdigest()
    assert signature_of(KEY, TOPIC, request) == expected


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda sent: sent.pop("signature"), "signature missing"),
        (lambda sent: sent.pop("nonce"), "nonce missing"),
        (lambda sent: sent.pop("t_us"), "t_us missing"),
        (lambda sent: sent.update(phase="abort"), "made with another key"),
        (lambda sent: sent.update(force=True), "made with another key"),
        (lambda sent: sent.update(nonce="f" * 32), "made with another key"),
        (lambda sent: sent.update(t_us=sent["t_us"] + 1), "made with another key"),
        (lambda sent: sent.update(signature="0" * 64), "made with another key"),
        (lambda sent: sent.update(signature="\ud800"), "made with another key"),
        (lambda sent: sent.update(signature=None), "made with another key"),
        (lambda sent: sent.update(nonce="short"), "16 to 64"),
        (lambda sent: sent.update(t_us=True), "whole microseconds"),
        (lambda sent: sent.update(t_us=1.5), "whole microseconds"),
    ],
)
def test_a_changed_request_is_refused(change: Callable[[dict[str, Any]], None], told: str) -> None:
    sent = sign_request(KEY, TOPIC, ASKED)
    change(sent)
    with pytest.raises(SignatureRejectedError, match=told):
        verify(KEY, TOPIC, sent, now_us())


def test_another_key_and_another_topic_are_refused() -> None:
    sent = sign_request(KEY, TOPIC, ASKED)
    for key, topic in ((KEY[::-1], TOPIC), (KEY, TOPIC.replace("bench-1", "bench-2"))):
        with pytest.raises(SignatureRejectedError, match="another key, for another topic"):
            verify(key, topic, sent, now_us())


@pytest.mark.parametrize(
    ("off_us", "told"), [(SIGNATURE_LIFETIME_US + 1, "old"), (-SIGNATURE_LIFETIME_US - 1, "ahead")]
)
def test_an_old_or_future_request_is_refused(off_us: int, told: str) -> None:
    sent = sign_request(KEY, TOPIC, ASKED)
    verify(
        KEY,
        TOPIC,
        sent,
        sent["t_us"] + off_us * SIGNATURE_LIFETIME_US // (SIGNATURE_LIFETIME_US + 1),
    )
    with pytest.raises(SignatureRejectedError, match=told):
        verify(KEY, TOPIC, sent, sent["t_us"] + off_us)


def test_signed_request_is_accepted_once(guard: RequestAuthenticator) -> None:
    sent = sign_request(KEY, TOPIC, ASKED)
    assert guard.check(TOPIC, sent) == ASKED
    with pytest.raises(SignatureRejectedError, match="used already"):
        guard.check(TOPIC, sent)


def test_request_signed_before_the_start_is_refused(tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(KEY)
    sent = sign_request(KEY, TOPIC, ASKED)
    time.sleep(0.001)
    late = RequestAuthenticator(MqttSettings(request_key_file=str(tmp_path / "key")))
    with pytest.raises(SignatureRejectedError, match="before the daemon started"):
        late.check(TOPIC, sent)


def test_nonce_memory_is_limited_and_expires(
    guard: RequestAuthenticator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_daemon.supervisor.requests._authentication.NONCE_CAPACITY", 3)
    for _ in range(3):
        guard.check(TOPIC, sign_request(KEY, TOPIC, ASKED))
    with pytest.raises(SignatureRejectedError, match="more than 3 requests"):
        guard.check(TOPIC, sign_request(KEY, TOPIC, ASKED))
    monkeypatch.setattr("jointfit_daemon.supervisor.requests._authentication._NONCE_LIFETIME_NS", 0)
    guard.check(TOPIC, sign_request(KEY, TOPIC, ASKED))


def test_without_a_key_in_the_rig_signatures_are_not_needed() -> None:
    guard = RequestAuthenticator(MqttSettings())
    assert guard.check(TOPIC, ASKED) == ASKED
    assert guard.check(TOPIC, sign_request(KEY, TOPIC, ASKED)) == ASKED


@pytest.mark.parametrize("content", [None, b"short"])
def test_missing_key_refuses_all_requests(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "key"
    if content is not None:
        path.write_bytes(content)
    guard = RequestAuthenticator(MqttSettings(request_key_file=str(path)))
    assert "request_key_file" in guard.fault
    for request in (ASKED, sign_request(b"short", TOPIC, ASKED)):
        with pytest.raises(SignatureRejectedError, match="no key to check"):
            guard.check(TOPIC, request)


def test_credential_takes_precedence_over_the_key_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "key").write_bytes(KEY[::-1])
    (tmp_path / "credentials").mkdir()
    (tmp_path / "credentials" / "key").write_bytes(KEY)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "credentials"))
    guard = RequestAuthenticator(MqttSettings(request_key_file=str(tmp_path / "key")))
    assert guard.check(TOPIC, sign_request(KEY, TOPIC, ASKED)) == ASKED


def asked(guard: RequestAuthenticator, request: dict[str, Any]) -> Request | Reply | None:
    return parse_request(Incoming(TOPIC, orjson.dumps(request), retained=False), guard)


def test_daemon_accepts_signed_requests_and_refuses_others(
    guard: RequestAuthenticator,
) -> None:
    good = asked(guard, sign_request(KEY, TOPIC, ASKED))
    assert isinstance(good, Request)
    assert good.arguments == {"phase": "static", "force": False}  # without the signature's keys
    refused = asked(guard, ASKED)
    assert isinstance(refused, Reply)
    assert refused.transaction == "a1"
    assert refused.error is not None
    assert refused.error["key"] == "signature"


def test_documented_signature_example_is_valid() -> None:
    text = PAGE.read_text(encoding="utf-8")
    key = re.search(r"^\| key \| `(.+)` \|$", text, re.MULTILINE)
    topic = re.search(r"^\| topic \| `(.+)` \|$", text, re.MULTILINE)
    request = re.search(r"^\| request without `signature` \| `(.+)` \|$", text, re.MULTILINE)
    signature = re.search(r"^\| signature \| `(.+)` \|$", text, re.MULTILINE)
    assert key
    assert topic
    assert request
    assert signature
    table = json.loads(request[1])
    assert canonical(topic[1], table) == f"{topic[1]}\n{request[1]}".encode()
    assert signature_of(key[1].encode(), topic[1], table) == signature[1]


def test_documented_shell_example_signs(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed (Debian: apt install openssl)")
    script = next(
        block
        for block in re.findall(r"```sh\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
        if "openssl dgst" in block
    )
    (tmp_path / "jointfitd.request-key").write_bytes(KEY + b"\n")
    # The arguments are "-t TOPIC -q 1 -m TEXT".
    (tmp_path / "mosquitto_pub").write_text('#!/bin/sh\nprintf %s "$6"\n')
    (tmp_path / "mosquitto_pub").chmod(0o755)
    done = subprocess.run(
        ["sh", "-ec", f'PATH="{tmp_path}:$PATH"\n{script}'],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    sent = json.loads(done.stdout)
    verify(KEY, TOPIC, sent, now_us())
    assert sent["phase"] == "static"
