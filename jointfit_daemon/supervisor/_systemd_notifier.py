"""Notification of systemd about readiness, reload, stop, watchdog and status line.

Invariant: no method raises an exception. Without systemd, the methods have no effect.

Source: sd_notify(3). A notification is a datagram of ``KEY=VALUE`` lines to $NOTIFY_SOCKET. A
leading ``@`` denotes an abstract socket.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time

TIMEOUT_S = 0.1
"""Longest wait for a service manager that does not read its socket, s."""


class SystemdNotifier:
    """Sends the state of the service to systemd if systemd started the process."""

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._status = ""

    @property
    def watchdog_s(self) -> float | None:
        """Longest interval between calls of `alive`, s; None without a watchdog."""
        pid = os.environ.get("WATCHDOG_PID")
        usec = os.environ.get("WATCHDOG_USEC", "")
        mine = pid is None or pid == str(os.getpid())
        return int(usec) / 1e6 if mine and usec.isdigit() and int(usec) > 0 else None

    def ready(self) -> None:
        """Report that the start or the reload is complete."""
        self._send("READY=1")

    def reloading(self) -> None:
        """Report that a reload begins. Call `ready` when it is complete."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """Report that the stop begins."""
        self._send("STOPPING=1")

    def alive(self) -> None:
        """Reset the watchdog."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """Set the status line if it has changed."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError),  # the socket is absent while systemd itself restarts
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify,
        ):
            notify.settimeout(TIMEOUT_S)
            notify.connect(self._address)
            notify.sendall(text.encode())
