"""What is wrong with a broker, in words with a remedy, from the errors of sockets and of MQTT.

Invariant: no text of a library or number of an error leaves it where the fault is known.
"""

from __future__ import annotations

import errno
import re

_ERRNO = re.compile(r"\[Errno (-?\d+)\]")
_CODE = re.compile(r"\[code:(\d+)\]")

_OF_THE_SYSTEM = {
    errno.ECONNREFUSED: (
        "connection refused: nothing listens there; start the broker, or correct host and port in"
        " [mqtt]"
    ),
    errno.ECONNRESET: (
        "the broker closed the connection: does it speak MQTT on this port, with or without TLS as"
        " [mqtt] says?"
    ),
    errno.EHOSTUNREACH: "no route to the host: check host in [mqtt], and the network",
    errno.ENETUNREACH: "no network reaches the host: check host in [mqtt], and the network",
    errno.ETIMEDOUT: "the host does not answer: check host in [mqtt], the network and firewalls",
    -2: "the name of the host is unknown: correct host in [mqtt], or write its address",
    -3: "the name of the host cannot be looked up now: check the network, or write its address",
}
"""By errno; the negative numbers are those of name lookup."""
_CREDENTIALS = (
    "the broker refuses user name or password: correct username and password_file in [mqtt]"
)
_RIGHTS = (  # mosquitto answers so to a wrong password, too
    "the broker does not authorize this user: correct username and password_file in [mqtt], or the"
    " broker's ACL"
)
_CONNECTION = "the connection was lost: is the broker running, and the network up?"
_OF_MQTT = {
    1: 'the broker does not speak this version of MQTT: set version = "3.1.1" or "5" in [mqtt]',
    2: "the broker refuses the client id: is another program connected with it?",
    3: "the broker is not available: look into its log",
    4: _CREDENTIALS,
    5: _RIGHTS,
    7: _CONNECTION,
    128: _CONNECTION,
    132: 'the broker does not speak this version of MQTT: set version = "3.1.1" or "5" in [mqtt]',
    133: "the broker refuses the client id: is another program connected with it?",
    134: _CREDENTIALS,
    135: _RIGHTS,
    136: "the broker is not available: look into its log",
    138: "the broker has banned this client: look into its log",
    151: "the broker's quota for this client is used up: look into its configuration",
    159: "the broker limits the rate of connections: wait, or look into its configuration",
}
"""By the reason code of MQTT 3.1.1 (below 128) or MQTT 5."""
_SESSION_LOST = (4, 7, 128)
"""Numbers of paho for "not connected" and "connection lost", and its reason for want of one."""


def broker_fault(error: BaseException) -> str:
    """Return the fault and its remedy; the text of `error` where it is not known."""
    text = str(error)
    if found := _ERRNO.search(text):
        return _OF_THE_SYSTEM.get(int(found[1]), text)
    if found := _CODE.search(text):
        return _OF_MQTT.get(int(found[1]), text)
    return text


def session_fault(error: BaseException) -> str:
    """Return the fault of an operation on an established connection, and its remedy.

    The numbers are those of paho there, of which 4 is "not connected" and not a wrong password.
    """
    text = str(error)
    if text == "Operation timed out":
        return "the broker does not answer in time: look into its log, and at the network"
    if (found := _CODE.search(text)) and int(found[1]) in _SESSION_LOST:
        return _CONNECTION
    return text
