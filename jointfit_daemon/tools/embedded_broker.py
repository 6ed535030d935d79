"""MQTT 5 broker for the demo and for tests, listening on the loopback interface.

Invariant: no other module imports the broker package iotcore. The broker is unsuitable for real
installations; see docs/mqtt.md.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HOST = "127.0.0.1"
START_S = 10.0
"""Time limit for the start of the broker, s."""

# If iotcore is configured by keyword arguments instead of a file, it listens on all interfaces and
# supports MQTT 3.1.1 only.
_CONFIG = """id = 0
[router]
id = 0
max_connections = 64
max_outgoing_packet_count = 200
max_segment_size = 104857600
max_segment_count = 10
[v5.1]
name = "v5"
listen = "{host}:{port}"
next_connection_delay_ms = 1
[v5.1.connections]
connection_timeout_ms = 60000
max_payload_size = 1048576
max_inflight_count = 100
dynamic_filters = true
"""


class BrokerMissingError(ImportError):
    """The broker package iotcore is not installed."""


def free_port() -> int:
    """Return a TCP port of the loopback interface that is currently free."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def embedded_broker(folder: Path) -> Iterator[int]:
    """Run a broker during the ``with`` block; yield its port.

    Raises
    ------
    BrokerMissingError
        The package iotcore is not installed. The extra ``demo`` contains it.
    TimeoutError
        The broker did not listen within `START_S`.
    """
    try:
        from iotcore import Broker
    except ModuleNotFoundError as missing:
        raise BrokerMissingError(
            "the demo needs the package iotcore: pip install 'jointfitd[demo]'"
        ) from missing

    port = free_port()
    config = folder / "broker.toml"
    config.write_text(_CONFIG.format(host=HOST, port=port), encoding="utf-8")
    broker = Broker(config_path=str(config))
    broker.start()
    try:
        until = time.monotonic() + START_S
        while not _listens(port):
            if time.monotonic() > until:
                raise TimeoutError(
                    f"the embedded broker does not listen on {HOST}:{port} after {START_S:g} s"
                )
            time.sleep(0.02)
        yield port
    finally:
        broker.stop()


def _listens(port: int) -> bool:
    try:
        socket.create_connection((HOST, port), timeout=0.2).close()
    except OSError:
        return False
    return True
