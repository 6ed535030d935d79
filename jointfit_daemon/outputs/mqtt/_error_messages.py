"""Messages for errors of sockets and of MQTT: cause and remedy.

Invariant: for a known error the message contains no error number and no text of a library.
"""

from __future__ import annotations

import errno
import re

_ERRNO = re.compile(r"\[Errno (-?\d+)\]")
_CODE = re.compile(r"\[code:(\d+)\]")

CONNECTION_CLOSED = (
    "the broker closed the connection: check that this port serves MQTT, with or without TLS"
    " as configured in [mqtt]"
)
CONNECTION_LOST = "the connection was lost: check that the broker runs, and the network"
NO_ANSWER = (
    "the broker does not answer in time: check its log, the network, and the load of this machine"
)

_SYSTEM_ERRORS = {
    errno.ECONNREFUSED: (
        "connection refused: no server listens on this port; start the broker, or correct host and"
        " port in [mqtt]"
    ),
    errno.ECONNRESET: CONNECTION_CLOSED,
    errno.EHOSTUNREACH: "no route to the host: check host in [mqtt], and the network",
    errno.ENETUNREACH: "network unreachable: check host in [mqtt], and the network",
    errno.ETIMEDOUT: "the host does not answer: check host in [mqtt], the network and firewalls",
    -2: "unknown host name: correct host in [mqtt], or use an address",
    -3: "the host name cannot be resolved at present: check the network, or use an address",
}
"""Messages by errno. Negative numbers are errors of name resolution."""
_VERSION = (
    'the broker does not support this version of MQTT: set version = "3.1.1" or "5" in [mqtt]'
)
_IDENTIFIER = "the broker refuses the client id: check that no other program uses it"
_UNAVAILABLE = "the broker is not available: check its log"
_CREDENTIALS = (
    "the broker refuses user name or password: set or correct username and password_file in [mqtt]"
)
_RIGHTS = (  # mosquitto sends this code for a wrong password, too
    "the broker does not authorize this user: set or correct username and password_file in [mqtt],"
    " or correct the broker's ACL"
)
_MQTT_ERRORS = {
    1: _VERSION,
    2: _IDENTIFIER,
    3: _UNAVAILABLE,
    4: _CREDENTIALS,
    5: _RIGHTS,
    7: CONNECTION_LOST,
    128: CONNECTION_LOST,
    132: _VERSION,
    133: _IDENTIFIER,
    134: _CREDENTIALS,
    135: _RIGHTS,
    136: _UNAVAILABLE,
    137: "the broker is busy: wait, or reduce the load of its machine",
    138: "the broker has banned this client: check its log",
    139: "the broker shuts down: start it again",
    140: (
        "the broker does not offer the authentication of this client: enable a user name with a"
        " password in the broker"
    ),
    149: "the broker accepts no packet of this size: raise its limit, such as max_packet_size",
    151: "the broker's quota for this client is used up: check its configuration",
    156: "the broker asks for the use of another server: correct host and port in [mqtt]",
    157: "the broker has moved: correct host and port in [mqtt]",
    159: "the broker limits the rate of connections: wait, or check its configuration",
}
"""Messages by the reason code of MQTT 3.1.1 (below 128) or MQTT 5."""
VERSION_REFUSED = (  # For an answer that is not MQTT, the library reports the same code.
    'the broker refuses MQTT 3.1.1, or this port does not serve MQTT: set version = "5", or correct'
    " host and port in [mqtt]"
)
_UNSPECIFIED = 128
"""Reason code "unspecified", to which paho converts all unknown codes of MQTT 3.1.1."""
_SESSION_LOST = (4, 7, 128)
"""Numbers that paho uses for "not connected" and "connection lost", and its default reason code."""


def refusal_fault(error: BaseException) -> str:
    """Return cause and remedy of a connection that the broker refused in its answer CONNACK."""
    found = _CODE.search(str(error))
    if found is None:
        return broker_fault(error)
    code = int(found[1])
    if code == _UNSPECIFIED:
        return "the broker refused the connection without a known reason: check its log"
    unknown = f"the broker refused the connection with code {code}: check its log"
    return _MQTT_ERRORS.get(code, unknown)


def broker_fault(error: BaseException) -> str:
    """Return cause and remedy of a failed connection, or the text of an unknown `error`."""
    text = str(error)
    if found := _ERRNO.search(text):
        return _SYSTEM_ERRORS.get(int(found[1]), text)
    if found := _CODE.search(text):
        code = int(found[1])
        if code > _UNSPECIFIED:  # smaller numbers are errors of paho, with text
            text = f"the broker ended the connection with code {code}: check its log"
        return _MQTT_ERRORS.get(code, text)
    return text


def session_fault(error: BaseException) -> str:
    """Return cause and remedy of a failed operation on an established connection.

    The error numbers of an operation are numbers of paho: 4 means "not connected", whereas the MQTT
    reason code 4 means "wrong password".
    """
    text = str(error)
    if text == "Operation timed out":
        return NO_ANSWER
    if (found := _CODE.search(text)) and int(found[1]) in _SESSION_LOST:
        return CONNECTION_LOST
    return text
