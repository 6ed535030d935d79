"""Fuzz targets of self-described devices: frames, lines and CAN frames, and any table."""

from __future__ import annotations

import tomllib
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, Corrupt
from jointfit_drivers.serial_table import SerialTableSettings
from jointfit_drivers.serial_table._decoder import open_codec
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.table import TableMessage
from tests.drivers.self_described import (
    CSV,
    FLOATS,
    HALVES,
    INTEGERS,
    LINES,
    PAGES,
    SBG,
    can_settings,
    serial_settings,
)
from tests.drivers.table_samples.test_fitting_settings import messages_of
from tests.fuzz.target import Target, UnaccountedError
from tests.fuzz.wire_targets import cut, records

if TYPE_CHECKING:
    from jointfit_daemon.driver import Driver
    from jointfit_drivers.can_table import CanTableSettings

PERIOD_NS = 10_000_000
TABLES: tuple[dict[str, Any], ...] = (INTEGERS, FLOATS, LINES, CSV)
HEAD = {"id": "S1", "segment": "thigh", "driver": "serial-table", "port": "/dev/ttyUSB0"}


@cache
def serial_tables() -> list[tuple[SerialTableSettings, Driver]]:
    """Return settings and driver of each serial table, cached because validation is slow."""
    found = [serial_settings("/dev/ttyUSB0", table) for table in TABLES]
    return [(settings, find_driver("serial-table")(settings)) for settings in found]


@cache
def can_tables() -> list[tuple[CanTableSettings, Driver]]:
    """Return settings and driver of each CAN table."""
    found = [can_settings("virtual", "fuzz", table) for table in (SBG, HALVES, PAGES)]
    return [(settings, find_driver("can-table")(settings)) for settings in found]


def run_table_bytes(data: bytes) -> None:
    """Decode serial bytes with four tables; every byte belongs to a message or is counted."""
    for settings, driver in serial_tables():
        codec, samples = open_codec(settings.wire_format()), driver.decoder()
        found: list[Any] = []
        for number, piece in enumerate(cut(data)):
            found += codec.feed(piece)
            samples.feed(Chunk(number * PERIOD_NS, piece))
        found += codec.flush()
        samples.flush()
        used = sum(
            len(item.data) if isinstance(item, TableMessage) else item.discarded for item in found
        )
        if used > len(data) or (used != len(data) and not codec.skipped):
            raise UnaccountedError(f"{len(data)} bytes, {used} in messages or discarded")


def run_table_frames(data: bytes) -> None:
    """Decode CAN frames of records ``u8 identifier, u8 size, data`` with three tables."""
    for settings, driver in can_tables():
        decoder, keys = driver.decoder(), settings.keys()
        for number, (kind, content) in enumerate(records(data)):
            key, extended = keys[kind % len(keys)]
            frame = CanFrame(number * PERIOD_NS, key, content[:8], extended)
            for item in decoder.feed(Chunk(number * PERIOD_NS, pack_frames([frame]))):
                if isinstance(item, Corrupt) and item.discarded <= 0:
                    raise UnaccountedError("a loss of no bytes")
        decoder.flush()


def run_table_settings(data: bytes) -> None:
    """Read a table, and decode with it if it is valid."""
    table = tomllib.loads(data.decode())
    settings = SerialTableSettings.model_validate(HEAD | table)
    decoder = find_driver("serial-table")(settings).decoder()
    for number in range(4):
        decoder.feed(Chunk(number * PERIOD_NS, b"\xaa\x55" + bytes(40) + b"1,2,3,4\n"))
    decoder.flush()


def seeds_bytes() -> list[bytes]:
    """Return streams of the four tables."""
    return [b"".join(messages_of(serial_settings("/dev/ttyUSB0", table), 5)) for table in TABLES]


def seeds_frames() -> list[bytes]:
    """Return complete samples as records."""
    return [b"\x00\x04\x40\x42\x0f\x00\x01\x08" + bytes.fromhex("004000c0cd0c9959")]


def seeds_settings() -> list[bytes]:
    """Return valid tables."""
    return [
        b'frame = { sync = "AA 55", length = 20, checksum = { kind = "crc16" } }\n'
        b'fields.quaternion = { offset = 2, type = "i16", divisor = 32767 }\n'
        b'fields.time = { offset = 10, type = "u32", unit = "us" }\n',
        b'text = { separator = ";", columns = 5 }\n'
        b'fields.quaternion = [{ column = 1, order = "wx" }, { column = 4, order = "yz" }]\n',
    ]


TARGETS = (
    Target("table-bytes", run_table_bytes, seeds_bytes, share=20),
    Target("table-frames", run_table_frames, seeds_frames, share=10),
    Target(
        "table-settings",
        run_table_settings,
        seeds_settings,
        refusals=(ValidationError, ValueError),
        share=5,
    ),
)
