"""Password and request key. Law: they come from files, and go nowhere but to who needs them.

Not into rig.toml, a log, an error, an argument, an event or a topic. systemd hands them over as
credentials, which no other service can read.
"""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

log = logging.getLogger(__name__)

CREDENTIAL = "jointfitd.mqtt-password"
LEAST_KEY_BYTES = 16
_OTHERS = stat.S_IROTH | stat.S_IWOTH


class RequestKeyError(Exception):
    """Requests must be signed, and the key to check them with cannot be had."""


def password_of(settings: MqttSettings) -> str | None:
    """Return the password in the file that rig.toml or systemd names; None if there is none."""
    path = settings.password_file
    if path is None and (credential := _credential(CREDENTIAL)) is not None:
        path = str(credential)
    if path is None:
        return None
    try:
        return Path(path).read_text(encoding="utf-8").rstrip("\r\n") or None
    except OSError as error:
        log.debug("mqtt: no password: %s", error)
        return None


def request_key_of(settings: MqttSettings) -> bytes | None:
    """Return the key that requests are signed with; None if they need not be.

    A systemd credential of the file's name is taken rather than the file.

    Raises
    ------
    RequestKeyError
        There ought to be one, and it is missing or too short.
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
            f"request_key_file = {named}: shorter than {LEAST_KEY_BYTES} bytes; make one with: "
            "openssl rand -hex 32"
        )
    return key


def security_warnings(settings: MqttSettings) -> list[str]:
    """Return what is open to others than it should be, a line each; empty when nothing is."""
    found = []
    if settings.insecure and not settings.is_local:
        found.append(
            f"broker {settings.host} is on another machine and spoken to without TLS: whoever is "
            "on the way can read and send everything, the password too"
        )
    tls_key = settings.tls.key if settings.tls is not None else None
    for name, path in (
        ("password_file", settings.password_file),
        ("request_key_file", settings.request_key_file),
        ("tls.key", tls_key),
    ):
        if path is not None and _open_to_others(Path(path)):
            found.append(f"{name} = {path}: every user of this machine can read it: chmod o-rw")
    return found


def _credential(name: str) -> Path | None:
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return None if folder is None else Path(folder) / name


def _open_to_others(path: Path) -> bool:
    try:
        return bool(path.stat().st_mode & _OTHERS)
    except OSError:
        return False
