"""Encoder of PUBLISH packets with QoS 0 (MQTT 5.0 and 3.1.1, section 3.3), without paho.

Invariant: the packets are identical to the packets of paho, byte for byte.
"""

from __future__ import annotations

from typing import Any

PUBLISH = 0x30
"""First byte of a PUBLISH packet at QoS 0."""
_RETAIN = 0x01
_MORE = 0x80
"""Bit of a length byte that is set if another length byte follows."""


class PublishEncoder:
    """Encodes messages with QoS 0. Topic and properties of a stream are encoded only once."""

    def __init__(self) -> None:
        self._headers: dict[str, tuple[Any, bytes]] = {}
        """Properties and variable header of the last message, by topic."""

    def encode(self, topic: str, payload: bytes, properties: Any, retain: bool) -> bytes:
        """Return the packet of one message.

        Parameters
        ----------
        topic, payload, retain
            Content of the message.
        properties
            Properties object of paho, which is not changed later. It is None with MQTT 3.1.1, which
            has no properties.
        """
        known, header = self._headers.get(topic, (None, b""))
        if not header or known is not properties:
            packed = b"" if properties is None else properties.pack()
            name = topic.encode()
            header = len(name).to_bytes(2) + name + packed
            self._headers[topic] = properties, header

        length = len(header) + len(payload)
        fixed = bytearray((PUBLISH | _RETAIN if retain else PUBLISH,))
        while length >= _MORE:  # seven bits per byte, lowest first (MQTT 5.0, 1.5.5)
            fixed.append(length % _MORE | _MORE)
            length >>= 7
        fixed.append(length)
        return b"".join((fixed, header, payload))
