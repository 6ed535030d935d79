"""Malformed and oversized requests at 1 kHz: `python -m bench.rigs.request_flood PORT BASE`.

Invariant: no request is valid. One MQTT 5 client sends all of them. The process prints the number
of sent requests and the time taken.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import cycle, islice
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

RATE_HZ, SECONDS = 1000, 10.0
_TURN_S = 0.005
"""Time between two bursts of requests, s."""


_Properties: Any = Properties  # the constructor has no annotations


def _properties(**values: Any) -> Any:
    made = _Properties(PacketTypes.PUBLISH)
    for name, value in values.items():
        setattr(made, name, value)
    return made


def kinds(base: str) -> list[tuple[str, bytes, Any]]:
    """Return topic, payload and properties of each type of invalid request."""
    root = f"{base}/bridge/request"
    topic = f"{root}/calibrate"
    return [
        (topic, b"", None),
        (topic, b"\xff\x00", None),
        (topic, b"[" * 1000 + b"]" * 1000, None),
        (topic, b'{"a":' * 400 + b"1" + b"}" * 400, None),
        (topic, json.dumps({f"k{number}": number for number in range(1500)}).encode(), None),
        (topic, b'{"phase":"static","seconds":"long"}', None),
        (topic, b" " * 4097, None),
        (topic, b"[" * 32_000, None),
        (topic, bytes(40_000), None),  # larger than the size limit of a packet
        (topic, b'{"phase":"static"}', _properties(ResponseTopic=f"{base}/pose")),
        (topic, b'{"phase":"static"}', _properties(ResponseTopic=root, CorrelationData=bytes(999))),
        (topic, b"[]", _properties(UserProperty=[("name", "x" * 50)] * 20)),
        (f"{root}/no-such-command", b"{}", None),
        (f"{root}/{'x' * 1000}", b"{}", None),
        (f"{root}/\N{RIGHT-TO-LEFT OVERRIDE} ", b"{}", None),
    ]


def main() -> None:
    """Connect, send all requests at a constant rate, wait for acknowledgements, and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("base")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    options = parser.parse_args()

    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
    client.connect("127.0.0.1", options.port)
    client.loop_start()
    count, began = round(RATE_HZ * options.seconds), time.monotonic()
    for number, (topic, payload, properties) in enumerate(
        islice(cycle(kinds(options.base)), count)
    ):
        if (early := began + number / RATE_HZ - time.monotonic()) > _TURN_S:
            time.sleep(early)
        # The number of types is odd, so each type is sent at both QoS levels.
        client.publish(topic, payload, number % 2, properties=properties)
    client.publish(f"{options.base}/bridge/request/last", b"[]", 1).wait_for_publish(SECONDS)
    print(json.dumps({"sent": count, "seconds": time.monotonic() - began}))
    client.disconnect()
    client.loop_stop()


if __name__ == "__main__":
    main()
