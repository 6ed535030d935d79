"""The five forms of the NatNet message CONNECT, which DISCOVERY also uses.

| bytes | content | sent by |
|---|---|---|
| 0 | nothing | libmotioncapture |
| 5 | ``Ping`` NUL | PyPI natnet |
| 264 | name[256], application version[4], NatNet version[4] | NatNetLib 3 |
| 269 | the 264 bytes above, subscribed data only, requested bitstream[4] | ``sConnectionOptions`` |
| 271 | ``Ping``, zeros to 264, then the five bytes of the 269 form, zeros | NaturalPoint's sample |

Source: NatNetTypes.h 4.1; a capture of NatNetLib 3; the clients in the table.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from jointfit_protocols.natnet._cursor import fixed_text, put_fixed_text

_FULL = struct.Struct("<256s4B4B")
_OPTIONS = struct.Struct("<B4B")
_PING = b"Ping\0"
_SAMPLE = 271
_NONE = (0, 0, 0, 0)

Version4 = tuple[int, int, int, int]


class Connect(NamedTuple):
    """Request of a client to connect. ``form`` is the length of its payload, bytes."""

    form: int = _FULL.size
    name: str = ""
    application_version: Version4 = _NONE
    natnet_version: Version4 = _NONE
    subscribed_only: bool = False
    bitstream: Version4 = _NONE
    """Bitstream requested from a unicast 4.x server. Zeros let the server choose the bitstream."""


def decode_connect(data: bytes) -> Connect | None:
    """Return the request in a payload of CONNECT or DISCOVERY; None if it has an unknown form."""
    size = len(data)
    if size == 0:
        return Connect(0)
    if data == _PING:
        return Connect(size, "Ping")
    if size not in (_FULL.size, _FULL.size + _OPTIONS.size, _SAMPLE):
        return None

    name, a, b, c, d, e, f, g, h = _FULL.unpack_from(data)
    found = Connect(size, fixed_text(name), (a, b, c, d), (e, f, g, h))
    if size == _FULL.size:
        return found

    only, i, j, k, m = _OPTIONS.unpack_from(data, _FULL.size)
    return found._replace(subscribed_only=bool(only), bitstream=(i, j, k, m))


def encode_connect(connect: Connect) -> bytes:
    """Return the payload of a request, which has the length `connect.form`.

    Raises
    ------
    ValueError
        No form has this length, or the name is too long.
    """
    if connect.form == 0:
        return b""
    if connect.form == len(_PING):
        return _PING

    name = put_fixed_text(connect.name, 256)
    full = _FULL.pack(name, *connect.application_version, *connect.natnet_version)
    options = _OPTIONS.pack(connect.subscribed_only, *connect.bitstream)
    forms = {
        _FULL.size: full,
        _FULL.size + _OPTIONS.size: full + options,
        _SAMPLE: (full + options).ljust(_SAMPLE, b"\0"),
    }

    if connect.form not in forms:
        raise ValueError(f"no form of CONNECT has {connect.form} bytes")
    return forms[connect.form]
