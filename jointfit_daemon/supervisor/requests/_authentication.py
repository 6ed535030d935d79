"""Who may ask: checks the signature of requests. Law: closed when in doubt, bounded memory.

Without ``[mqtt] request_key_file`` the broker's access list alone decides, and all pass here.
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
    request_key_of,
    verify,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.config import MqttSettings

NONCE_CAPACITY = 4096
"""Requests within a minute; only those of who has the key count, so nobody else can fill it."""
_KEPT_NS = 2 * SIGNATURE_LIFETIME_US * 1000


class RequestAuthenticator:
    """Lets signed requests pass, each once.

    What was signed before the guard was made is refused: it could have run under its predecessor,
    whose memory of nonces is gone.

    Parameters
    ----------
    settings
        ``[mqtt]``; the key is read once, now.
    """

    def __init__(self, settings: MqttSettings) -> None:
        self._key: bytes | None = None
        self.fault = ""
        """Why no request can be let pass; empty: they can."""
        try:
            self._key = request_key_of(settings)
        except RequestKeyError as missing:
            self.fault = str(missing)
        self._since_us = time.time_ns() // 1000
        self._used: OrderedDict[str, int] = OrderedDict()

    def check(self, topic: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return `request` without what only the guard needs.

        Raises
        ------
        SignatureRejectedError
            It must be signed, and is not as it should be.
        """
        if self.fault:
            raise SignatureRejectedError(
                "the daemon has no key to check requests with; its log says why"
            )
        if self._key is not None:
            nonce, t_us = verify(self._key, topic, request, time.time_ns() // 1000)
            if t_us < self._since_us:
                raise SignatureRejectedError("t_us: from before the daemon started: sign it anew")
            self._use_up(nonce, time.monotonic_ns())
        return {name: value for name, value in request.items() if name not in SIGNING_KEYS}

    def _use_up(self, nonce: str, now_ns: int) -> None:
        while self._used and now_ns - next(iter(self._used.values())) > _KEPT_NS:
            self._used.popitem(last=False)
        if nonce in self._used:
            raise SignatureRejectedError("nonce: used already: every request needs a new one")
        if len(self._used) >= NONCE_CAPACITY:
            raise SignatureRejectedError("too many requests within a minute")
        self._used[nonce] = now_ns
