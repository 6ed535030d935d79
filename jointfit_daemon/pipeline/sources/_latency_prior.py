"""What is known of a source's smallest delay before a sample of it came.

Law: a function of the rig's tables. Arrivals alone can never tell a constant delay, so the mean is
taken out of stamps and the standard deviation is published beside theirs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jointfit_daemon.config import Source

_NS_PER_MS = 1e6
CAN_MS = (0.1, 0.1)
UART_MS = (0.2, 0.2)
USB_MS = (1.0, 0.7)
DATAGRAM_MS = (0.5, 0.5)
_USB_NAMES = ("usb", "acm")


class LatencyPrior(NamedTuple):
    """Smallest delay from sampled instant to arrival, ns."""

    mean_ns: int
    sd_ns: int


def latency_prior(source: Source) -> LatencyPrior:
    """Return the prior of a source: as set, as its driver says, or by its transport.

    A driver may have a class attribute ``least_delay_ms``, or its settings a property
    ``usual_delay_ms`` where it depends on them: mean and standard deviation, ms.
    """
    settings = source.settings
    asked = getattr(settings, "least_delay_ms", None) or getattr(settings, "usual_delay_ms", None)
    told = getattr(source.driver_class, "least_delay_ms", None)
    mean, sd = asked or told or _of_transport(source)
    return LatencyPrior(round(mean * _NS_PER_MS), round(sd * _NS_PER_MS))


def _of_transport(source: Source) -> tuple[float, float]:
    wire = source.driver_class.wire
    if wire == "can":
        return CAN_MS
    if wire == "datagram":
        return DATAGRAM_MS
    port = str(getattr(source.settings, "port", "")).lower()
    usb = getattr(source.settings, "transport", None) == "usb"
    return USB_MS if usb or any(name in port for name in _USB_NAMES) else UART_MS
