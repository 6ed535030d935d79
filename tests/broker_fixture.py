"""Real brokers on free loopback ports, started and stopped by tests: mosquitto and iotcore.

Invariant: each broker is a process of this user, with MQTT 5 at ``port`` and MQTT 3.1.1 at
``port_of("3.1.1")``. Each can be stopped, frozen and started again on the same ports.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import zlib
from abc import ABC, abstractmethod
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar

from typing_extensions import override  # typing has it from Python 3.12

if TYPE_CHECKING:
    from pathlib import Path

HOST = os.environ.get("JOINTFIT_TEST_HOST", "127.0.0.1")
"""Address of the loopback; a machine without IPv4 has ``::1`` only."""
MOSQUITTO_MISSING = "mosquitto is not installed (Debian: apt install mosquitto)"
CHOICE = "JOINTFIT_TEST_BROKER"
"""Environment variable that names the broker for tests that accept any broker."""


def free_port() -> int:
    """Return a TCP port of the loopback that no program uses."""
    with socket.socket(socket.AF_INET6 if ":" in HOST else socket.AF_INET) as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
        return port


def address(port: int) -> str:
    """Return a port of the loopback as ``host:port``."""
    return f"[{HOST}]:{port}" if ":" in HOST else f"{HOST}:{port}"


def wait_for_listener(port: int, within_s: float = 5.0) -> None:
    """Wait until a program accepts connections on `port` of the loopback."""
    until = time.monotonic() + within_s
    while True:
        try:
            socket.create_connection((HOST, port), timeout=0.2).close()
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.02)
        else:
            return


class Broker(ABC):
    """One broker process."""

    PATH: ClassVar[str] = f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin"
    host: ClassVar[str] = HOST

    def __init__(self, port: int | None = None) -> None:
        self.port = port or free_port()
        self._process: subprocess.Popen[bytes] | None = None

    @classmethod
    @abstractmethod
    def missing(cls) -> str | None:
        """Return why this broker cannot run here, and how to install it; None if it can."""

    @abstractmethod
    def _command(self) -> list[str]:
        """Return the program and its arguments."""

    def port_of(self, version: str) -> int:
        """Return the port for clients of an MQTT version, "5" or "3.1.1"."""
        del version  # most brokers serve every version on one port
        return self.port

    @property
    def pid(self) -> int:
        """Process id of the running broker."""
        assert self._process is not None, "the broker is not running"
        return self._process.pid

    def start(self) -> None:
        """Start the process and wait until it listens."""
        self._process = subprocess.Popen(
            self._command(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for version in ("5", "3.1.1"):
            wait_for_listener(self.port_of(version))

    def stop(self) -> None:
        """Kill the process: connections break and retained messages are lost."""
        if self._process is not None:
            self.thaw()
            self._process.kill()
            self._process.wait()
            self._process = None

    def freeze(self) -> None:
        """Stop the process without closing its connections."""
        if self._process is not None:
            self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue a frozen process."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)


class MosquittoBroker(Broker):
    """Mosquitto with one listener; `more` are further lines of its configuration.

    By default it has a free port.
    """

    def __init__(self, folder: Path, *, port: int | None = None, more: str = "") -> None:
        super().__init__(port)
        self.config = folder / f"mosquitto-{self.port}-{zlib.crc32(more.encode()):08x}.conf"
        self.config.write_text(
            f"listener {self.port} {HOST}\nallow_anonymous true\npersistence false\n"
            f"set_tcp_nodelay true\nuser {os.environ.get('USER') or 'root'}\n{more}",
            encoding="utf-8",
        )

    @classmethod
    @override
    def missing(cls) -> str | None:
        if shutil.which("mosquitto", path=cls.PATH) is not None:
            return None
        return MOSQUITTO_MISSING

    @override
    def _command(self) -> list[str]:
        program = shutil.which("mosquitto", path=self.PATH)
        assert program is not None, self.missing()
        return [program, "-c", str(self.config)]


class EmbeddedBroker(Broker):
    """iotcore, the broker of the demo, with a listener for each MQTT version."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._port_of_3_1_1 = free_port()
        self.config = folder / f"iotcore-{self.port}.toml"
        self.config.write_text(self._config_text(), encoding="utf-8")

    @classmethod
    @override
    def missing(cls) -> str | None:
        if find_spec("iotcore") is not None:
            return None
        return "iotcore is not installed (pip install jointfitd[demo])"

    @override
    def port_of(self, version: str) -> int:
        return self.port if version == "5" else self._port_of_3_1_1

    @override
    def _command(self) -> list[str]:
        return [sys.executable, "-P", "-c", _SERVE, str(self.config)]

    def _config_text(self) -> str:
        router = """id = 0
[router]
id = 0
max_connections = 1000
max_outgoing_packet_count = 200
max_segment_size = 104857600
max_segment_count = 10
"""
        listener = """
[{section}.1]
name = "{section}"
listen = "{address}"
next_connection_delay_ms = 1
[{section}.1.connections]
connection_timeout_ms = 60000
max_payload_size = 1048576
max_inflight_count = 100
dynamic_filters = true
"""
        return (
            router
            + listener.format(section="v4", address=address(self._port_of_3_1_1))
            + listener.format(section="v5", address=address(self.port))
        )


_SERVE = """
import sys
from iotcore.iotcore import IotCoreBroker
IotCoreBroker(config_path=sys.argv[1]).run_forever()
"""
# The class Broker of iotcore is not used, because tests cannot freeze its private process.

_CLASSES: dict[str, type[MosquittoBroker | EmbeddedBroker]] = {
    "mosquitto": MosquittoBroker,
    "embedded": EmbeddedBroker,
}


def chosen_broker() -> type[MosquittoBroker | EmbeddedBroker]:
    """Return the broker for tests that accept any broker.

    The environment variable `CHOICE` names the broker. Without the variable, it is mosquitto if
    mosquitto is installed, because users run mosquitto, and else the embedded broker.

    Raises
    ------
    ValueError
        The variable names no broker.
    """
    name = os.environ.get(CHOICE)
    if not name:
        return MosquittoBroker if MosquittoBroker.missing() is None else EmbeddedBroker
    if name not in _CLASSES:
        message = f"{CHOICE}={name}: expected {' or '.join(_CLASSES)}"
        raise ValueError(message)
    return _CLASSES[name]
