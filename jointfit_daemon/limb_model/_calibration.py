"""What a calibration is once it is done: everything live fusion needs, and how good it was.

Law: frozen plain data with an exact JSON form. `from_dict(to_dict(c)) == c`, to the last bit, also
through text; NaN and infinity never occur. No clock and no version of its own: both are handed in.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, cast

from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model._marker_cluster import StoredCluster, vector
from jointfit_daemon.limb_model._segment_model import SegmentModel
from jointfit_daemon.limb_model._sensor_link import SensorLink

if TYPE_CHECKING:
    from collections.abc import Mapping


if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Chain, Quaternion, Vector

SCHEMA = 1
"""Version of the JSON form; a reader refuses what it does not know."""


class UnknownSchema(ValueError):  # noqa: N818 - named for what happened
    """The JSON is no calibration, or one of another version of this program."""


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """One sensor on its segment."""

    q_optical_world: Quaternion
    """From the sensor's own world to the optical one (or to the static world, without cameras)."""
    q_sensor_segment: Quaternion
    """Bias: how the segment lies in the sensor, from the static pose."""
    lag_ns: int = 0
    """Sensor stamp minus optical stamp of the same event."""
    spread: float = 0.0
    """Robust scatter in the static pose, rad."""


@dataclass(frozen=True, slots=True)
class SegmentCalibration:
    """One segment and the models that give its orientation from whatever sensors are alive."""

    q_static: Quaternion
    """q_optical_segment in the static pose."""
    length: float | None
    """Between its joint centers, m; None if unknown."""
    length_sd: float | None
    models: Mapping[str, SegmentModel] = field(default_factory=dict)
    """By `alive_key`: one for every set of sensors that was trained."""


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """One joint center."""

    center: Vector | None
    """In the optical world of the static pose, m."""
    sd: float | None
    """Root of the mean variance per axis, m."""
    source: str
    """``fit`` | ``length`` | ``unknown``."""
    residual_rms: float | None = None
    """Of the markers' distances from it, m."""
    gap_rms: float | None = None
    """How far apart its two body parts carry it, m."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibration of one limb on one wearer."""

    method: Method
    joints: tuple[str, ...]
    segments: tuple[str, ...]
    chain_sensors: tuple[tuple[str, ...], ...]
    sensor: Mapping[str, SensorCalibration]
    segment: Mapping[str, SegmentCalibration]
    joint: Mapping[str, JointCalibration]
    clusters: Mapping[str, StoredCluster] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    """What every LimbState must say: ``headings_from_static``, ``facing_unknown``, …"""
    notes: tuple[str, ...] = ()
    """Sentences for people: what was not found and what to do."""
    quality: Mapping[str, Any] = field(default_factory=dict)
    digest: str = ""
    """SHA-256 of the trials' arrays."""
    software: str = ""
    created_utc: str = ""
    links: tuple[SensorLink, ...] = ()
    """What is expected between sensors; empty where no movement was seen."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """How far the errors of both segments of an inner joint are alike, see `joint_correlation`."""
    memory: str = ""
    """Frames it was taught with, see `memory`; empty in calibrations of earlier versions."""

    @property
    def lag_ns(self) -> dict[str, int]:
        """Lag of every sensor."""
        return {name: sensor.lag_ns for name, sensor in self.sensor.items()}

    def fits(self, chain: Chain) -> bool:
        """Tell whether this is a calibration of that chain: same segments, joints and sensors."""
        mine = (self.joints, self.segments, self.chain_sensors)
        return mine == (chain.joints, chain.segments, chain.sensors)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form: dicts, lists, numbers, strings, None."""
        return {
            "schema": SCHEMA,
            "method": self.method,
            "joints": list(self.joints),
            "segments": list(self.segments),
            "chain_sensors": [list(group) for group in self.chain_sensors],
            "sensor": {name: _sensor_dict(item) for name, item in self.sensor.items()},
            "segment": {name: _segment_dict(item) for name, item in self.segment.items()},
            "joint": {name: _joint_dict(item) for name, item in self.joint.items()},
            "clusters": {name: _cluster_dict(item) for name, item in self.clusters.items()},
            "flags": list(self.flags),
            "notes": list(self.notes),
            "quality": dict(self.quality),
            "digest": self.digest,
            "software": self.software,
            "created_utc": self.created_utc,
            "links": [link.to_dict() for link in self.links],
            "correlations": dict(self.correlations),
            "memory": self.memory,
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Calibration:
        """Return the calibration of a JSON form.

        Raises
        ------
        UnknownSchema
            Not a calibration, incomplete, or of another schema version.
        """
        if data.get("schema") != SCHEMA:
            raise UnknownSchema(f"schema {data.get('schema')!r}, this program reads {SCHEMA}")
        if type(data["schema"]) is not int:
            raise UnknownSchema(f"schema {data['schema']!r}, expected a whole number")
        try:
            return _from_dict(data)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise UnknownSchema(f"not a calibration: {type(error).__name__}: {error}") from error


def alive_key(sensors: Sequence[str], other: str | None) -> str:
    """Return the name of an alive set: sensors of the segment, then the one of its neighbour."""
    return f"{'+'.join(sensors)}|{other or ''}"


def _sensor_dict(item: SensorCalibration) -> dict[str, Any]:
    return {
        "q_optical_world": list(item.q_optical_world),
        "q_sensor_segment": list(item.q_sensor_segment),
        "lag_ns": item.lag_ns,
        "spread": item.spread,
    }


def _segment_dict(item: SegmentCalibration) -> dict[str, Any]:
    return {
        "q_static": list(item.q_static),
        "length": item.length,
        "length_sd": item.length_sd,
        "models": {key: model.to_dict() for key, model in item.models.items()},
    }


def _joint_dict(item: JointCalibration) -> dict[str, Any]:
    return {
        "center": None if item.center is None else list(item.center),
        "sd": item.sd,
        "source": item.source,
        "residual_rms": item.residual_rms,
        "gap_rms": item.gap_rms,
    }


def _cluster_dict(item: StoredCluster) -> dict[str, Any]:
    return {
        "markers": list(item.markers),
        "body": item.body,
        "template": [list(row) for row in item.template],
        "origin": list(item.origin),
        "q_body": list(item.q_body),
    }


def _from_dict(data: Mapping[str, Any]) -> Calibration:
    return Calibration(
        method=cast("Method", data["method"]),
        joints=tuple(data["joints"]),
        segments=tuple(data["segments"]),
        chain_sensors=tuple(tuple(group) for group in data["chain_sensors"]),
        sensor={name: _sensor(item) for name, item in data["sensor"].items()},
        segment={name: _segment(item) for name, item in data["segment"].items()},
        joint={name: _joint(item) for name, item in data["joint"].items()},
        clusters={name: _cluster(item) for name, item in data["clusters"].items()},
        flags=tuple(data["flags"]),
        notes=tuple(data["notes"]),
        quality=dict(data["quality"]),
        digest=data["digest"],
        software=data["software"],
        created_utc=data["created_utc"],
        links=tuple(SensorLink.from_dict(link) for link in data.get("links", ())),
        correlations={name: _alike(rho) for name, rho in data.get("correlations", {}).items()},
        memory=str(data.get("memory", "")),
    )


def _alike(value: Any) -> float:
    if not -1.0 < (rho := float(value)) < 1.0:
        raise ValueError(f"correlation {rho}")
    return rho


def _sensor(item: Mapping[str, Any]) -> SensorCalibration:
    return SensorCalibration(
        as_quaternion(item["q_optical_world"]),
        as_quaternion(item["q_sensor_segment"]),
        int(item["lag_ns"]),
        float(item["spread"]),
    )


def _segment(item: Mapping[str, Any]) -> SegmentCalibration:
    return SegmentCalibration(
        as_quaternion(item["q_static"]),
        item["length"],
        item["length_sd"],
        {key: SegmentModel.from_dict(model) for key, model in item["models"].items()},
    )


def _joint(item: Mapping[str, Any]) -> JointCalibration:
    return JointCalibration(
        None if item["center"] is None else vector(item["center"]),
        item["sd"],
        item["source"],
        item["residual_rms"],
        item["gap_rms"],
    )


def _cluster(item: Mapping[str, Any]) -> StoredCluster:
    return StoredCluster(
        tuple(item["markers"]),
        item["body"],
        tuple(vector(row) for row in item["template"]),
        vector(item["origin"]),
        as_quaternion(item["q_body"]),
    )


Method = Literal["anchored", "patent12", "patent6", "markley", "mean", "single"]
