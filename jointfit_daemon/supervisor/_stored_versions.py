"""Summaries of the stored calibrations for the request ``calibrations``.

The file of each calibration is read without the checks that are necessary before the calibration
is used. A list of summaries therefore takes only milliseconds.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon.calibration.record import MOST_BYTES, CalibrationFileError
from jointfit_daemon.files.text import MalformedFileError, read_bounded
from jointfit_daemon.outputs.payloads import quality_payload
from jointfit_daemon.supervisor._calibration_store import store_of

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration

_ONLINE = ("rounds", "from_version", "before_deg", "after_deg")
"""Keys of the last refit by online learning in a summary."""
_UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, MalformedFileError)


@dataclass(frozen=True, slots=True)
class VersionSummary:
    """Summary of one stored calibration."""

    version: int
    created_utc: str | None = None
    software: str | None = None
    method: str | None = None
    procedure: str | None = None
    restored_from: int | None = None
    """Version from which this version was copied; None if it is not a copy."""
    online: dict[str, Any] | None = None
    """Last refit of this version's models by online learning; None without a refit. The keys are
    the number of refits since the functional phase, the previous version, and the errors before and
    after the refit."""
    functional: bool | None = None
    """Whether the calibration includes a functional phase with the cameras; None if unknown."""
    usable: bool = False
    """Whether the calibration fits the limb and the sensors of the rig."""
    segments_deg: dict[str, float | None] = field(default_factory=dict)
    """RMS orientation error of each segment on held-out movement, with the method in use, deg."""
    flexion_deg: dict[str, float | None] = field(default_factory=dict)
    """RMS flexion error of each joint on held-out movement, with the method in use, deg."""
    fault: str | None = None
    """Reason why the file cannot be read; None if it can."""


class StoredVersions:
    """Lists and loads the stored calibrations of a rig. Call its methods in a thread."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, int], tuple[dict[str, Any], bytes]] = {}
        """Cache of summaries and limb layouts of files, because a stored version never changes."""

    def list(self, rig: Rig, count: int) -> dict[str, Any]:
        """Return the newest `count` versions, newest first, and the number of older versions."""
        store = store_of(rig)
        numbers = store.versions()[::-1]
        found = [asdict(self._summary(rig, number)) for number in numbers[:count]]
        return {
            "store": rig.calibration_store,
            "versions": found,
            "omitted": len(numbers) - len(found),
        }

    def load(self, rig: Rig, version: int) -> Calibration:
        """Return a stored calibration.

        Raises
        ------
        CalibrationFileError
            The version does not exist, or its file cannot be used; the message states the remedy.
        """
        try:
            return store_of(rig).load(version)
        except OSError as error:
            raise CalibrationFileError(f"{error.filename}: {error.strerror}") from error

    def before(self, rig: Rig, version: int | None) -> int | None:
        """Return the newest usable version older than `version`; None if there is none."""
        for number in reversed(store_of(rig).versions()):
            older = version is None or number < version
            if older and self._summary(rig, number).usable:
                return number
        return None

    def _summary(self, rig: Rig, version: int) -> VersionSummary:
        key = (rig.calibration_store, version)
        if key not in self._seen:
            path = store_of(rig).path(version)
            try:
                content = orjson.loads(read_bounded(path, MOST_BYTES))["calibration"]
                parts = tuple(content[name] for name in ("joints", "segments", "chain_sensors"))
                self._seen[key] = _figures(content), orjson.dumps(parts)
            except _UNREADABLE as error:
                text = (
                    f"{path}: cannot be read ({str(error) or type(error).__name__:.200}): use "
                    "another version, or restore the file from a copy"
                )
                return VersionSummary(version, fault=text)

        figures, layout = self._seen[key]
        chain = rig.chain
        wanted = orjson.dumps((chain.joints, chain.segments, chain.sensors))
        return VersionSummary(version, usable=layout == wanted, **figures)


def _figures(content: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a summary that do not depend on the rig."""
    quality, method = quality_payload(content["quality"]), content["method"]
    holdout, learned = quality.get("holdout") or {}, quality.get("online")
    return {
        "created_utc": content["created_utc"],
        "software": content["software"],
        "method": method,
        "procedure": content.get("procedure", "corrected"),
        "restored_from": (quality.get("restored") or {}).get("from_version"),
        "online": learned and {key: learned.get(key) for key in _ONLINE},
        "functional": bool(holdout),
        **{
            table: {name: errors.get(method) for name, errors in (holdout.get(table) or {}).items()}
            for table in ("segments_deg", "flexion_deg")
        },
    }
