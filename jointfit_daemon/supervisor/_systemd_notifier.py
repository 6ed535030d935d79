"""Talks to systemd's notify socket. Law: silent where there is none; never raises.

Protocol: sd_notify(3): datagrams of ``KEY=VALUE`` lines to $NOTIFY_SOCKET, ``@`` is abstract.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time

PATIENCE_S = 0.1


class SystemdNotifier:
    """Tells systemd how the service is; does nothing outside systemd."""

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._status = ""

    @property
    def watchdog_s(self) -> float | None:
        """Return the time within which ``alive`` must be called, s; None without a watchdog."""
        pid = os.environ.get("WATCHDOG_PID")
        usec = os.environ.get("WATCHDOG_USEC", "")
        mine = pid is None or pid == str(os.getpid())
        return int(usec) / 1e6 if mine and usec.isdigit() and int(usec) > 0 else None

    def ready(self) -> None:
        """Say that the configuration is good and the tasks run."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Say that a reload begins; ``ready`` ends it."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Say that a stop began."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the status line, if it changed."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError),  # systemd itself restarts now and then
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify,
        ):
            notify.settimeout(PATIENCE_S)  # a manager that does not read must not stop the loop
            notify.connect(self._address)
            notify.sendall(text.encode())
