"""Authentication of requests by signature and nonce.

Invariant: without a usable key every request is refused, each signed request passes once, and the
memory of nonces is limited. Without ``[mqtt] request_key_file`` all requests pass; the access list
of the broker then decides.
"""

from __future__ import annotations

import time
from collections import OrderedDict
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
"""Largest number of signed requests per minute; only owners of the key can reach this number."""
_NONCE_LIFETIME_NS = 2 * SIGNATURE_LIFETIME_US * 1000
"""Time for which a nonce is stored, ns. A signature is valid for at most this time."""


class RequestAuthenticator:
    """Verifies the signature of requests, and accepts each request once.

    Requests signed before the authenticator was created are refused: an earlier process, whose
    nonces are lost, may have accepted them.

    Parameters
    ----------
    settings
        ``[mqtt]``; the key is read once, at creation.
    """

    def __init__(self, settings: MqttSettings) -> None:
        self._key: bytes | None = None
        self.fault = ""
        """Reason why every request is refused; empty if requests are accepted."""
        try:
            self._key = request_key_of(settings)
        except RequestKeyError as missing:
            self.fault = str(missing)
        self._since_us = time.time_ns() // 1000
        self._used: OrderedDict[str, int] = OrderedDict()

    def check(self, topic: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return `request` without the keys of its signature.

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

            # Each nonce is accepted once.
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
