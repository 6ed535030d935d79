"""Signatures of requests, for client and daemon. Shell tools can compute the same signatures.

A signed request has three additional keys::

    t_us        UNIX time of signing, microseconds
    nonce       16 to 64 letters, digits and dashes, new for every request
    signature   HMAC-SHA256, in hexadecimal, of topic, newline, and canonical text

The canonical text is the JSON of the request without ``signature``. Its keys are sorted, it has no
blanks, and it is UTF-8 without escapes, as ``jq -cS`` prints it. The signature covers the full
topic, so a request for one rig or command is invalid for another.

Source: RFC 2104 (HMAC), FIPS 180-4 (SHA-256).
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from typing import TYPE_CHECKING, Any

import orjson

if TYPE_CHECKING:
    from collections.abc import Mapping

SIGNATURE_LIFETIME_US = 30_000_000
"""Largest absolute difference between the time of a signature and the current time, µs."""
SIGNING_KEYS = ("nonce", "signature", "t_us")
"""Keys that a signature adds to a request."""
_NONCE = re.compile(r"[A-Za-z0-9-]{16,64}")


class SignatureRejectedError(Exception):
    """The signature of a request is missing, wrong, expired or already used."""


def canonical(topic: str, request: Mapping[str, Any]) -> bytes:
    """Return the bytes over which the signature is computed."""
    table = {name: value for name, value in request.items() if name != "signature"}
    return topic.encode() + b"\n" + orjson.dumps(table, option=orjson.OPT_SORT_KEYS)


def signature_of(key: bytes, topic: str, request: Mapping[str, Any]) -> str:
    """Return the signature of `request` on `topic`."""
    return hmac.new(key, canonical(topic, request), hashlib.sha256).hexdigest()


def sign_request(key: bytes, topic: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return `request` with the current time, a nonce and the signature."""
    stamped = {**request, "t_us": time.time_ns() // 1000, "nonce": secrets.token_hex(16)}
    return stamped | {"signature": signature_of(key, topic, stamped)}


def verify(key: bytes, topic: str, request: Mapping[str, Any], now_us: int) -> tuple[str, int]:
    """Return nonce and time of a request with a valid signature.

    Raises
    ------
    SignatureRejectedError
        A key is missing or malformed, the signature is wrong, or `t_us` is too far from `now_us`.
    """
    if missing := [name for name in SIGNING_KEYS if name not in request]:
        raise SignatureRejectedError(
            f"this rig accepts signed requests only: {', '.join(missing)} missing"
        )

    nonce, signature, t_us = (request[name] for name in SIGNING_KEYS)
    if not isinstance(nonce, str) or not _NONCE.fullmatch(nonce):
        raise SignatureRejectedError("nonce: expected 16 to 64 letters, digits or dashes")
    if not isinstance(t_us, int) or isinstance(t_us, bool):
        raise SignatureRejectedError("t_us: expected UNIX time in whole microseconds")

    right = signature_of(key, topic, request).encode()
    if not hmac.compare_digest(str(signature).encode(errors="replace"), right):
        raise SignatureRejectedError(
            "signature: made with another key, for another topic, or for other content"
        )
    check_age(t_us, now_us)
    return nonce, t_us


def check_age(t_us: object, now_us: int) -> None:
    """Check the time of a request, with or without a signature.

    Raises
    ------
    SignatureRejectedError
        `t_us` is not a time, or too far from `now_us`.
    """
    if not isinstance(t_us, int) or isinstance(t_us, bool):
        raise SignatureRejectedError("t_us: expected UNIX time in whole microseconds")
    if abs(off_us := now_us - t_us) > SIGNATURE_LIFETIME_US:
        where = "old" if off_us > 0 else "ahead"
        raise SignatureRejectedError(
            f"t_us: {abs(off_us) / 1e6:.0f} s {where}, at most "
            f"{SIGNATURE_LIFETIME_US // 1_000_000} s are allowed: send the request again with the "
            "present time, and compare the clocks of both machines"
        )
