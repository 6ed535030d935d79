"""Authentication of requests by a signature and a nonce, which is a text that is used only once.

Invariant: if a key is configured but cannot be used, every request is refused. Each signed request
is accepted once, and the number of stored nonces is limited. Without ``[mqtt] request_key_file``,
all requests are accepted; only the broker's access list can then restrict them.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from hashlib import sha256
from typing import TYPE_CHECKING, Any

from jointfit_daemon.outputs.mqtt import (
    SIGNATURE_LIFETIME_US,
    SIGNING_KEYS,
    RequestKeyError,
    SignatureRejectedError,
    check_age,
    request_key_of,
    verify,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import MqttSettings

NONCE_CAPACITY = 4096
"""Largest number of signed requests per minute. Only owners of the key can reach this number."""
_NONCE_LIFETIME_NS = 2 * SIGNATURE_LIFETIME_US * 1000
"""Time for which a nonce is stored, ns. No signature is valid for longer."""


class RequestAuthenticator:
    """Verifies the signature of requests, and accepts each request once.

    Requests that were signed before this object was created are refused. An earlier process may
    have accepted them, and its nonces are lost.

    Parameters
    ----------
    settings
        Table ``[mqtt]``. The key is read once, when the object is created.
    """

    def __init__(self, settings: MqttSettings) -> None:
        self._key: bytes | None = None
        self.fault = ""
        """Reason why all requests are refused; empty if requests are accepted."""
        try:
            self._key = request_key_of(settings)
        except RequestKeyError as missing:
            self.fault = str(missing)
        self.fingerprint = (sha256(self._key or b"").hexdigest(), self.fault)
        """Digest of the key, and the fault."""
        self._since_us = time.time_ns() // 1000
        self._used: OrderedDict[str, int] = OrderedDict()

    def continuing(self, before: RequestAuthenticator | None) -> RequestAuthenticator:
        """Return `before`, which knows the used nonces, if it has the same key; else `self`."""
        if before is not None and self.fingerprint == before.fingerprint:
            return before
        return self

    def check(self, topic: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Check the signature of `request`; return the request without the signature's keys.

        Raises
        ------
        SignatureRejectedError
            A required signature is missing or wrong, or the request has expired.
        """
        if self.fault:
            raise SignatureRejectedError(
                "the daemon has no key to check signatures with: see its log for the reason"
            )
        if self._key is not None:
            nonce, t_us = verify(self._key, topic, request, time.time_ns() // 1000)
            if t_us < self._since_us:
                raise SignatureRejectedError(
                    "t_us: from before the daemon started: sign the request again"
                )

            # Each nonce is accepted only once.
            now_ns = time.monotonic_ns()
            while self._used and now_ns - next(iter(self._used.values())) > _NONCE_LIFETIME_NS:
                self._used.popitem(last=False)
            if nonce in self._used:
                raise SignatureRejectedError("nonce: used already: every request needs a new one")
            if len(self._used) >= NONCE_CAPACITY:
                raise SignatureRejectedError(f"more than {NONCE_CAPACITY} requests within a minute")
            self._used[nonce] = now_ns
        elif "t_us" in request:
            check_age(request["t_us"], time.time_ns() // 1000)
        return {name: value for name, value in request.items() if name not in SIGNING_KEYS}
