"""Reader of the ground truth that the simulator writes while the demo runs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, BinaryIO

import orjson

from jointfit_daemon.tools.demo._score import TrueLimbState, TruthTrack

if TYPE_CHECKING:
    from pathlib import Path


class TruthReader:
    """Reads new lines of ``truth.jsonl``; an incomplete line is read later."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO | None = None
        self._rest = b""
        self._joint = "knee"
        self.track = TruthTrack()

    def read(self) -> None:
        """Read the lines written since the last call."""
        if self._file is None:
            if not self._path.exists():
                return
            self._file = self._path.open("rb")

        *lines, self._rest = (self._rest + self._file.read()).split(b"\n")
        for line in lines:
            row = orjson.loads(line)
            if "truth" in row:  # the first line is the header
                self._joint = row.get("joint", self._joint)
                continue

            centers = {
                name: tuple(math.nan if x is None else x for x in center)
                for name, center in row["joint_m"].items()
            }
            flexion = row[self._joint]["flexion"]
            self.track.add(
                TrueLimbState(
                    row["t_ns"],
                    row["motion"],
                    {name: tuple(q) for name, q in row["q_world_segment"].items()},
                    centers,  # type: ignore[arg-type]  # the log has three numbers per centre
                    math.nan if flexion is None else flexion,
                )
            )

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
