"""Recognition of a device by decoding received data with all installed drivers.

Invariant: all functions are pure, except that they import drivers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_daemon.tools.discovery._mocap_servers import installed_drivers

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from jointfit_daemon.device_search import CanSearch
    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Chunk

LEAST_SAMPLES = 3
"""Minimum number of samples that identify a driver. Noise can pass the checksum of one sample."""
LEAST_MESSAGES = 5
"""Minimum number of messages that identify a driver if the device sends no orientation."""
MOST_FOREIGN = 0.1
"""Largest share of bytes that belong to no message, for a device without orientations. With a
larger share, the driver does not recognize the device."""
_USUAL_RATES = (
    1,
    5,
    10,
    20,
    25,
    30,
    40,
    50,
    60,
    75,
    80,
    100,
    120,
    150,
    200,
    250,
    300,
    400,
    500,
    1000,
)
"""Usual output rates of devices, Hz. A rate measured in a short time has an error of a few percent.
"""
_NEAR = 0.06
"""Largest relative difference at which a measured rate is replaced by a usual rate."""


Layouts: TypeAlias = "Mapping[str, Sequence[Mapping[str, Any]]]"
"""Tables of rig.toml that describe the data format of a device, by driver."""


@dataclass(frozen=True, slots=True)
class DecodedDevice:
    """One device whose data a driver decodes."""

    driver: str
    settings: dict[str, Any]
    """Keys of the device's table in rig.toml, without the connection keys."""
    messages: int
    """Number of well-formed messages."""
    samples: int
    """Number of orientations."""
    rate_hz: float | None
    """Measured rate of the orientations, Hz; None if fewer than two orientations arrived."""
    discarded_bytes: int
    """Number of bytes that belong to no message. Reception often starts within a message, so a few
    such bytes are usual."""
    properties: dict[str, Any] = field(default_factory=dict)
    """Properties of the device from its messages, such as its model."""
    warnings: tuple[str, ...] = ()

    @property
    def usual_rate_hz(self) -> int | None:
        """The rate for rig.toml, Hz: a usual rate near the measured rate, or the rounded rate.

        It is None if no rate was measured.
        """
        if self.rate_hz is None:
            return None
        nearest = min(_USUAL_RATES, key=lambda rate: abs(rate - (self.rate_hz or 0)))
        if abs(nearest - self.rate_hz) <= _NEAR * nearest:
            return nearest
        return max(1, round(self.rate_hz))


def decode_stream(
    chunks: Sequence[Chunk],
    baud: int | None = None,
    *,
    other_than: str = "",
    layouts: Layouts | None = None,
) -> tuple[DecodedDevice, ...]:
    """Return one device for each driver and table that decode a byte stream, most samples first.

    Parameters
    ----------
    chunks
        Received bytes.
    baud
        Speed of the line, baud; None if unknown.
    other_than
        Driver that is not tried.
    layouts
        Tables to try in addition to the default table of each driver.
    """
    found = []
    for name, driver in installed_drivers():
        if driver.wire == "stream" and name != other_than:
            fields = driver.Settings.model_fields
            table = {"baud": baud} if "baud" in fields and baud is not None else {}
            described = (layouts or {}).get(name, ())
            found += [
                decode_traffic(driver, name, {**table, **layout}, chunks)
                for layout in ({}, *described)
            ]
    return tuple(sorted(filter(None, found), key=lambda device: -device.samples))


def decode_frames(
    sizes: Mapping[tuple[int, bool], int],
    chunks: Sequence[Chunk],
    *,
    layouts: Layouts | None = None,
) -> Iterator[DecodedDevice]:
    """Yield the sensors that the installed drivers decode; each identifier belongs to one sensor.

    Parameters
    ----------
    sizes
        Number of data bytes of each frame, by identifier and a flag for 29-bit identifiers.
    chunks
        Received CAN frames.
    layouts
        Tables to try in addition to the tables that the drivers propose.
    """
    used: set[tuple[int, bool]] = set()
    for name, driver in installed_drivers():
        described = (layouts or {}).get(name, ()) if driver.wire == "can" else ()
        for table in (*_candidate_tables(driver, sizes), *described):
            keys = used_identifiers(table)
            device = None if keys & used else decode_traffic(driver, name, table, chunks)
            if device is not None and device.samples:
                used |= keys
                yield device


def _candidate_tables(
    driver: type[Driver], sizes: Mapping[tuple[int, bool], int]
) -> Iterable[Mapping[str, Any]]:
    """Return the tables to try for a CAN driver: those that it proposes, or the default table.

    There are none for other drivers, or if no frame was received.
    """
    if driver.wire != "can" or not sizes:
        return ()
    if hasattr(driver, "candidate_tables"):
        return cast("CanSearch", cast("Any", driver)).candidate_tables(sizes)
    return ({},)


def used_identifiers(table: Mapping[str, Any]) -> set[tuple[int, bool]]:
    """Return the identifiers in the key ``ids`` of a table, each with its 29-bit flag."""
    extended = bool(table.get("extended_ids"))
    return {(number, extended) for number in (table.get("ids") or {}).values()}


def decode_traffic(
    driver: type[Driver], name: str, table: Mapping[str, Any], chunks: Sequence[Chunk]
) -> DecodedDevice | None:
    """Return the device that sent `chunks`; None if `driver` does not decode the data.

    Parameters
    ----------
    driver, name
        Class and name of the driver.
    table
        Keys of the driver's table that determine the decoding.
    chunks
        Received bytes or CAN frames, with their arrival times.
    """
    from jointfit_daemon.tools.decoder_settings import decoder_settings

    try:
        decoder = driver(decoder_settings(driver, name, table)).decoder()
    except ValueError:  # the settings of this candidate are invalid
        return None
    items = [item for chunk in chunks for item in decoder.feed(chunk)] + decoder.flush()

    samples = [item for item in items if isinstance(item, ImuSample)]
    events = [item for item in items if isinstance(item, DeviceEvent)]
    received = sum(len(chunk.data) for chunk in chunks)
    clean = decoder.discarded_bytes <= MOST_FOREIGN * received
    if len(samples) < LEAST_SAMPLES and not (decoder.messages >= LEAST_MESSAGES and clean):
        return None

    rate_hz = None
    if len(samples) > 1 and (span_ns := samples[-1].arrival_ns - samples[0].arrival_ns) > 0:
        rate_hz = (len(samples) - 1) * 1e9 / span_ns
    properties = {k: v for event in events if event.kind == "info" for k, v in event.data.items()}

    # A warning names the setting that removes its cause. The rate is excluded because it is
    # measured.
    proposed = {
        key: value
        for event in events
        if event.kind == "warning"
        for key, value in event.data.items()
        if key in driver.Settings.model_fields and key not in table and key != "rate_hz"
    }
    return DecodedDevice(
        driver=name,
        settings={**table, **proposed},
        messages=decoder.messages,
        samples=len(samples),
        rate_hz=rate_hz,
        discarded_bytes=decoder.discarded_bytes,
        properties=properties,
        warnings=tuple(
            dict.fromkeys(event.text for event in events if event.kind in ("warning", "error"))
        ),
    )
