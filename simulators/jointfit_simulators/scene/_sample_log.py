r"""When every sample was truly taken, for whoever judges the clocks: one JSON object a line.

Law: what was sent, and nothing else: samples that were dropped or unheard are not told. A sample is
named by its device and the number it carries on the wire, which begins anew where the device does::

    {"id": "S1", "number": 4711, "host_ns": true instant of sampling, host CLOCK_MONOTONIC}
"""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

import orjson

if TYPE_CHECKING:
    from pathlib import Path


class SampleLog:
    """A file that grows with every sample sent.

    Parameters
    ----------
    path
        Where; overwritten.
    """

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("wb")

    def add(self, name: str, number: int, host_ns: int) -> None:
        """Tell of one sample."""
        line = {"id": name, "number": number, "host_ns": host_ns}
        self._file.write(orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE))

    def close(self) -> None:
        """Close the file."""
        self._file.close()
