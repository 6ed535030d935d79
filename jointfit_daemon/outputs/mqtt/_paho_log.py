"""Logger for paho that stores the error with which a broker ended a connection."""

from __future__ import annotations

import logging


class PahoLog(logging.Logger):
    """Logger of paho that stores the last socket exception instead of logging it.

    With TLS 1.3, a broker rejects the client's certificate after the handshake. paho only logs the
    alert, and aiomqtt reports a timeout, so the stored exception is the only source of the cause.
    """

    def __init__(self) -> None:
        super().__init__("mqtt", logging.ERROR)
        self.last: OSError | None = None

    def handle(self, record: logging.LogRecord) -> None:  # type: ignore[explicit-override]  # Python 3.12's
        """Store the exception of `record`, if there is one."""
        for value in record.args if isinstance(record.args, tuple) else ():
            if isinstance(value, OSError):
                self.last = value
        if record.exc_info:  # a callback of the daemon failed, which is a bug
            logging.getLogger(__name__).handle(record)
