"""Checks of the broker: address, TLS, credentials, permissions, and clients with equal ids."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from jointfit_daemon.config import missing_files
from jointfit_daemon.device_search import Finding
from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt import BrokerLostError, MqttClient

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

CHECK = "broker"
_STORED_S = 1.0
"""Time to wait for the retained state of a daemon, s."""


async def check_broker(settings: MqttSettings) -> list[Finding]:
    """Return the findings about the broker; the check uses its own client id."""
    address = f"{settings.host}:{settings.tcp_port}"
    missing = missing_files(settings)
    findings = [
        Finding(CHECK, address, "error", text, "create the file, or correct its name in [mqtt]")
        for text in missing
    ]
    try:
        async with MqttClient(settings) as client:
            await client.subscribe("bridge/state")
            state = await _state(client)
    except BrokerLostError as error:
        text = str(error).removeprefix(f"broker {address}: ")
        return [*findings, Finding(CHECK, address, "error", text, _remedy(error, settings))]

    identifier = topics.client_identifier(settings.base)
    if state == "online":
        text = f"a daemon is connected with the client id {identifier!r}"
        remedy = "stop it before another daemon with the same base starts, or set another base"
        findings.append(Finding(CHECK, address, "note", text, remedy))
    if not missing:
        findings.append(Finding(CHECK, address, "ok", "reachable, and accepts the credentials"))
    return findings


async def _state(client: MqttClient) -> str | None:
    """Return the retained state of the daemon with this base topic; None if there is none."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_STORED_S):
            async for topic, payload in client.messages():
                if topic == "bridge/state":
                    return payload.get("state") if isinstance(payload, dict) else None
    return None


def _remedy(error: BrokerLostError, settings: MqttSettings) -> str:
    """Return the command that helps to correct a connection error."""
    text = str(error).casefold()
    host, port = settings.host, settings.tcp_port
    if "refused: no server" in text:
        return "sudo systemctl start mosquitto; or correct host and port in [mqtt]"
    if "user name" in text or "authorize" in text:
        return "sudo mosquitto_passwd /etc/mosquitto/passwd USER; and correct [mqtt]"
    if "tls" in text or "certificate" in text:
        return f"openssl s_client -connect {host}:{port}"
    if "host" in text or "network" in text:
        return f"ping {host}"
    return "sudo journalctl -u mosquitto -n 20"
