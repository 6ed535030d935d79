"""Password and request key, read from files or systemd credentials.

Invariant: secrets appear in no configuration file, log line, error, argument, event or topic. Other
services cannot read a systemd credential.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

log = logging.getLogger(__name__)

CREDENTIAL = "jointfitd.mqtt-password"
"""Name of the systemd credential that contains the password."""
LEAST_KEY_BYTES = 16
"""Shortest request key, bytes. A key of 128 bits cannot be guessed."""
_OTHERS = stat.S_IROTH | stat.S_IWOTH


class RequestKeyError(Exception):
    """Requests must be signed, but the key is missing or too short."""


def password_of(settings: MqttSettings) -> str | None:
    """Return the password from `password_file` or the systemd credential.

    The result is None if there is no password, or if the file cannot be read.
    """
    path = _password_path(settings)
    if path is None:
        return None
    try:
        return path.read_text(encoding="utf-8").rstrip("\r\n") or None
    except OSError as error:
        log.debug("mqtt: no password: %s", error)
        return None


def missing_password(settings: MqttSettings) -> str | None:
    """Return why the configured user has no password; None if there is a password or no user."""
    if settings.username is None or password_of(settings) is not None:
        return None
    path = _password_path(settings)
    if path is None:
        return "set password_file in [mqtt]"

    source = "systemd credential" if settings.password_file is None else "password_file ="
    try:
        path.read_bytes()
    except OSError as error:
        return f"{source} {path}: {error.strerror}"
    return f"{source} {path}: the file contains no password"


def request_key_of(settings: MqttSettings) -> bytes | None:
    """Return the key that signs requests; None if requests need no signature.

    A systemd credential with the name of the file takes precedence over the file.

    Raises
    ------
    RequestKeyError
        A key file is configured, but is missing or too short.
    """
    if settings.request_key_file is None:
        return None

    named = Path(settings.request_key_file)
    credential = _credential(named.name)
    path = credential if credential is not None and credential.is_file() else named
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise RequestKeyError(f"request_key_file = {named}: {error.strerror}") from error
    if len(key) < LEAST_KEY_BYTES:
        raise RequestKeyError(
            f"request_key_file = {named}: shorter than {LEAST_KEY_BYTES} bytes; create one with: "
            "openssl rand -hex 32"
        )
    return key


def security_warnings(settings: MqttSettings) -> list[str]:
    """Return one line for each security weakness, such as plain MQTT or readable secrets."""
    found = []
    if settings.insecure and not settings.is_local:
        found.append(
            f"broker {settings.host} is on another machine and the connection is without TLS: any "
            "host on the network path can read and send all messages, the password included"
        )

    tls_key = settings.tls.key if settings.tls is not None else None
    for name, path in (
        ("password_file", settings.password_file),
        ("request_key_file", settings.request_key_file),
        ("tls.key", tls_key),
    ):
        with contextlib.suppress(OSError):
            if path is not None and Path(path).stat().st_mode & _OTHERS:
                found.append(
                    f"{name} = {path}: every user of this machine can read or replace it: run "
                    f"chmod o-rw {path}"
                )
    return found


def _password_path(settings: MqttSettings) -> Path | None:
    if settings.password_file is not None:
        return Path(settings.password_file)
    return _credential(CREDENTIAL)


def _credential(name: str) -> Path | None:
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return None if folder is None else Path(folder) / name
