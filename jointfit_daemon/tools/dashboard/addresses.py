"""Addresses of the web server and of the broker in the options of the dashboard."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from urllib.parse import urlsplit

LISTEN = "127.0.0.1:8080"
"""Default address of the page. Only this machine can open it."""
PLAIN_PORT, TLS_PORT = 1883, 8883
"""Registered TCP ports of MQTT without and with TLS."""
_SCHEMES = ("mqtt", "mqtts", "ws", "wss")


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """Address of the web server."""

    host: str
    port: int
    """TCP port; 0 selects a free port."""

    @property
    def is_local(self) -> bool:
        """Whether only this machine can connect."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


@dataclass(frozen=True, slots=True)
class BrokerAddress:
    """Address of an MQTT broker: TCP or TLS for the tunnel, or a WebSocket URL for the page."""

    host: str
    port: int
    tls: bool = False
    websocket: str | None = None
    """URL of the broker's own WebSocket listener; the page then connects without the tunnel."""

    @property
    def text(self) -> str:
        """Return the address as text for messages."""
        if self.websocket is not None:
            return self.websocket
        return f"{bracket_ipv6(self.host)}:{self.port}{' (TLS)' if self.tls else ''}"


def bracket_ipv6(host: str) -> str:
    """Return `host` in the form of URLs, with IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host


def parse_listen(text: str) -> ListenAddress:
    """Return the address of ``HOST:PORT``, ``[IPv6]:PORT`` or ``PORT``.

    Raises
    ------
    ValueError
        `text` has none of these forms.
    """
    expected = f"--listen {text}: expected HOST:PORT, such as 127.0.0.1:8080"
    try:
        parts = urlsplit(f"//127.0.0.1:{text}" if text.isdecimal() else f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        raise ValueError(expected) from None
    if not host or port is None or parts.path or parts.query or parts.username is not None:
        raise ValueError(expected)
    return ListenAddress(host, port)


def parse_broker(text: str, account: str = "the page asks for them") -> BrokerAddress:
    """Return the address of ``mqtt://HOST:PORT``, ``mqtts://…``, ``wss://…`` or ``HOST:PORT``.

    `account` is the last part of the error message about a user name in the address. This part
    states where the user enters name and password.

    Raises
    ------
    ValueError
        `text` has none of these forms, or contains a user name or password.
    """
    expected = (
        f"--broker {text}: expected mqtt://HOST:PORT, mqtts://HOST:PORT (TLS), or wss://HOST/PATH"
    )
    try:
        parts = urlsplit(text if "://" in text else f"mqtt://{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        raise ValueError(expected) from None

    # A password in the arguments would be visible to every user of this machine.
    if parts.username is not None:
        raise ValueError(
            f"--broker {parts.scheme}://…@{host or ''}: expected no user name and no password;"
            f" {account}"
        )
    if not host or parts.scheme not in _SCHEMES or port == 0:
        raise ValueError(expected)
    if parts.scheme in ("ws", "wss"):
        return BrokerAddress(host, port or 0, parts.scheme == "wss", parts.geturl())
    if parts.path not in ("", "/") or parts.query:
        raise ValueError(expected)
    tls = parts.scheme == "mqtts"
    return BrokerAddress(host, port or (TLS_PORT if tls else PLAIN_PORT), tls)
