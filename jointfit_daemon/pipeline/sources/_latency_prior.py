"""Prior knowledge of the smallest delay from a sample to its arrival.

A constant delay cannot be observed from arrival times. The prior mean is therefore subtracted from
the stamps, and the prior standard deviation is published with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from jointfit_daemon.config import Source

CAN_MS = (0.1, 0.1)
"""Mean and standard deviation of the delay on a CAN bus, ms; a CAN frame at 1 Mbit/s takes 0.1 ms.
"""
UART_MS = (0.2, 0.2)
"""Mean and standard deviation of the delay on a UART, ms."""
USB_MS = (1.0, 0.7)
"""Mean and standard deviation of the delay on USB, ms; the host polls once per millisecond."""
DATAGRAM_MS = (0.5, 0.5)
"""Mean and standard deviation of the delay of datagrams on a local network, ms."""
_USB_NAMES = ("usb", "acm")


class LatencyPrior(NamedTuple):
    """Prior of the smallest delay from sampling to arrival, ns."""

    mean_ns: int
    sd_ns: int


def latency_prior(source: Source) -> LatencyPrior:
    """Return the prior of a source from its configuration, its driver, or its transport.

    A driver declares mean and standard deviation, ms, in the class attribute ``least_delay_ms``. If
    the delay depends on settings, the driver's settings have the property ``usual_delay_ms``
    instead.
    """
    settings = source.settings
    configured = getattr(settings, "least_delay_ms", None) or getattr(
        settings, "usual_delay_ms", None
    )
    declared = getattr(source.driver_class, "least_delay_ms", None)
    if delay := configured or declared:
        mean, sd = delay
    elif source.driver_class.wire == "can":
        mean, sd = CAN_MS
    elif source.driver_class.wire == "datagram":
        mean, sd = DATAGRAM_MS
    else:
        port = str(getattr(settings, "port", "")).lower()
        usb = getattr(settings, "transport", None) == "usb"
        mean, sd = USB_MS if usb or any(name in port for name in _USB_NAMES) else UART_MS
    return LatencyPrior(round(mean * NS_PER_MS), round(sd * NS_PER_MS))
