"""An MQTT broker inside pip, for the demo: MQTT 5, loopback only, its own process.

Law: the only module that imports iotcore. It is young software: never the broker of a real
installation (docs/mqtt.md says what to use there).
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

# The keyword form of iotcore's Broker listens on every interface and speaks 3.1.1 only; a
# configuration file does neither.
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
    """The embedded broker is not installed; the message says how to get it."""


def free_port() -> int:
    """Return a TCP port of the loopback that nobody listens on just now."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def embedded_broker(folder: Path) -> Iterator[int]:
    """Run a broker while the block runs; yield its port.

    Raises
    ------
    BrokerMissingError
        iotcore is not installed: it comes with the extra ``demo``.
    TimeoutError
        It did not listen within ten seconds.
    """
    try:
        from iotcore import Broker
    except ModuleNotFoundError as missing:
        raise BrokerMissingError(
            "the demo needs a broker: pip install 'jointfitd[demo]'"
        ) from missing

    port = free_port()
    config = folder / "broker.toml"
    config.write_text(_CONFIG.format(host=HOST, port=port), encoding="utf-8")
    broker = Broker(config_path=str(config))
    broker.start()
    try:
        _wait_for_listener(port)
        yield port
    finally:
        broker.stop()


def _wait_for_listener(port: int) -> None:
    until = time.monotonic() + START_S
    while time.monotonic() < until:
        try:
            socket.create_connection((HOST, port), timeout=0.2).close()
        except OSError:
            time.sleep(0.02)
        else:
            return
    message = f"the embedded broker does not listen on {HOST}:{port} after {START_S:g} s"
    raise TimeoutError(message)
