r"""Log of the true sampling times for clock experiments, with one JSON object per line.

Invariant: only samples that were sent are logged.

A sample is identified by its device and its transmitted number. The numbers restart with the
device::

    {"id": "S1", "number": 4711, "host_ns": true instant of sampling, host CLOCK_MONOTONIC}
"""

from __future__ import annotations

from typing import TYPE_CHECKING, BinaryIO

import orjson

if TYPE_CHECKING:
    from pathlib import Path


class SampleLog:
    """Writer of the sample log.

    Parameters
    ----------
    path
        Output file. An existing file is overwritten.
    """

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("wb")

    def add(self, name: str, number: int, host_ns: int) -> None:
        """Append one sample."""
        line = {"id": name, "number": number, "host_ns": host_ns}
        self._file.write(orjson.dumps(line, option=orjson.OPT_APPEND_NEWLINE))

    def close(self) -> None:
        """Close the file."""
        self._file.close()
