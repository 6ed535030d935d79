"""Real brokers on free loopback ports, started and stopped by tests."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from pathlib import Path

    from iotcore import Broker

HOST = "127.0.0.1"


def free_port() -> int:
    """Return a TCP port of the loopback that nobody listens on just now."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port: int = probe.getsockname()[1]
        return port


def wait_for_listener(port: int, within_s: float = 5.0) -> None:
    """Return once somebody accepts connections on `port` of the loopback."""
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


class MosquittoBroker:
    """One mosquitto process; it can be stopped, frozen and started again on the same port."""

    PATH: ClassVar[str] = f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin"
    host: ClassVar[str] = HOST

    def __init__(self, folder: Path, *, more: str = "") -> None:
        self.port = free_port()
        self._config = folder / f"mosquitto-{self.port}.conf"
        self._config.write_text(
            f"listener {self.port} {HOST}\nallow_anonymous true\npersistence false\n"
            f"set_tcp_nodelay true\nuser {os.environ.get('USER') or 'root'}\n{more}",
            encoding="utf-8",
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process and wait until it listens."""
        program = shutil.which("mosquitto", path=self.PATH)
        if program is None:
            raise FileNotFoundError("mosquitto")
        self._process = subprocess.Popen(
            [program, "-c", str(self._config)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_for_listener(self.port)

    def stop(self) -> None:
        """Kill the process: connections break and retained messages are forgotten."""
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
        """Let a frozen process go on."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)


class IotcoreBroker:
    """The embedded broker of the demo, bound to the loopback."""

    host: ClassVar[str] = HOST

    def __init__(self, folder: Path) -> None:
        self.port, self.port5 = free_port(), free_port()
        self._folder = folder
        self._broker: Broker | None = None

    def start(self) -> None:
        """Start the child process and wait until both listeners answer."""
        from iotcore import Broker  # noqa: PLC0415 - an extra

        self._broker = Broker(config_path=str(self._write_config()))
        self._broker.start()
        wait_for_listener(self.port)
        wait_for_listener(self.port5)

    def stop(self) -> None:
        """Stop the child process."""
        if self._broker is not None:
            self._broker.stop()
            self._broker = None

    def _write_config(self) -> Path:
        listener = """
[{section}.1]
name = "{section}"
listen = "127.0.0.1:{port}"
next_connection_delay_ms = 1
[{section}.1.connections]
connection_timeout_ms = 60000
max_payload_size = 1048576
max_inflight_count = 100
dynamic_filters = true
"""
        text = """id = 0
[router]
id = 0
max_connections = 1000
max_outgoing_packet_count = 200
max_segment_size = 104857600
max_segment_count = 10
"""
        text += listener.format(section="v4", port=self.port)
        text += listener.format(section="v5", port=self.port5)
        path = self._folder / "iotcore.toml"
        path.write_text(text, encoding="utf-8")
        return path
