"""Access to the library of the Lab Streaming Layer: import, search for streams, and clock.

pylsl is an optional extra. Its calls block, so they all run in threads of the driver.
"""

from __future__ import annotations

import ctypes
import socket
import time
from typing import Any

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_protocols.lsl import RoundTrip

_READINGS = 5
"""Number of comparisons of the LSL clock with the host clock. The fastest comparison is used."""


def load_library() -> Any:
    """Return the module pylsl.

    Raises
    ------
    DeviceMisconfiguredError
        pylsl or its library liblsl is not installed.
    """
    try:
        import pylsl  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as missing:
        raise DeviceMisconfiguredError(
            "mocap.driver: lsl-markers needs the package pylsl: add it with pip install "
            "'jointfitd[lsl]'"
        ) from missing
    except (RuntimeError, OSError) as missing:  # pylsl is installed without liblsl
        raise DeviceMisconfiguredError(
            "mocap.driver: the package pylsl, which lsl-markers needs, finds no library liblsl."
            " The packages of pylsl contain liblsl for x86-64 only: install liblsl"
            " (https://github.com/sccn/liblsl) and set PYLSL_LIB to its path"
        ) from missing
    return pylsl


def search_streams(
    lsl: Any, query: str, server: str | None, *, least: int, wait_s: float
) -> list[Any]:
    """Return the `pylsl.StreamInfo` of all streams that answer; block for at most `wait_s`.

    Parameters
    ----------
    lsl : module
        The module pylsl.
    query : str
        XPath predicate that selects streams.
    server : str, optional
        Address or name of the sender. Streams of other senders are ignored. None: all senders.
    least : int
        Number of streams after which the search ends early.
    wait_s : float
        Longest duration of the search, s.
    """
    found = lsl.resolve_bypred(query, minimum=least, timeout=wait_s)
    return [info for info in found if server is None or _is_sender(server, info.hostname())]


def _is_sender(server: str, hostname: str) -> bool:
    """Return whether `server` is the PC with the name `hostname`; streams contain no address."""
    name = hostname.lower()
    if server.lower() in {name, name.partition(".")[0]}:
        return True
    if hostname == socket.gethostname() and server in {"localhost", "127.0.0.1"}:
        return True
    return bool(addresses_of(server) & addresses_of(hostname))


def addresses_of(host: str) -> set[str]:
    """Return the IPv4 addresses of a host; empty if its name cannot be resolved."""
    try:
        return {str(one[4][0]) for one in socket.getaddrinfo(host, None, family=socket.AF_INET)}
    except (OSError, UnicodeError):
        return set()


def compare_clocks(lsl: Any, inlet: Any, wait_s: float) -> RoundTrip | None:
    """Return the latest comparison of the sender's clock with CLOCK_MONOTONIC of this host.

    liblsl queries the sender every few seconds, and uses the reply with the shortest round-trip
    time. The uncertainty of the comparison is this round-trip time. The result is None if no reply
    arrives within `wait_s`.
    """
    remote, uncertainty, code = ctypes.c_double(), ctypes.c_double(), ctypes.c_int()
    ask = lsl.lib.lib.lsl_time_correction_ex  # `StreamInlet.time_correction` has no uncertainty
    ask.restype = ctypes.c_double
    offset_s = ask(
        inlet.obj,
        ctypes.byref(remote),
        ctypes.byref(uncertainty),
        ctypes.c_double(wait_s),
        ctypes.byref(code),
    )
    if code.value:
        return None

    # In the usual builds on Linux, the LSL clock is CLOCK_MONOTONIC. Other builds may have another
    # clock, so the difference is measured.
    readings = []
    for _ in range(_READINGS):
        before_ns = time.monotonic_ns()
        lsl_s = lsl.local_clock()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, (before_ns + after_ns) // 2 - round(lsl_s * 1e9)))
    width_ns, difference_ns = min(readings)
    middle_ns = round((remote.value + offset_s) * 1e9) + difference_ns
    half_ns = round(uncertainty.value * 0.5e9) + width_ns // 2
    return RoundTrip(middle_ns - half_ns, middle_ns + half_ns, remote.value)
