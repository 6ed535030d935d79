"""Record of a calibration, with all parameters that fusion evaluates and with quality figures.

Invariants: ``Calibration.from_dict(c.to_dict()) == c`` to the last bit, even after a conversion to
JSON text. The record never contains NaN or infinity. The caller supplies the time of creation and
the software version.

The *static world* is the coordinate system of the static pose. With cameras, it is the optical
world as it was during the static pose: all points on a body part are stored in the coordinates
that they had then. Without cameras, z is up, and all segments are upright and face +y.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypedDict, cast

from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model._json_form import fields_form
from jointfit_daemon.limb_model._marker_cluster import StoredCluster, vector
from jointfit_daemon.limb_model._refined_chain import RefinedChain
from jointfit_daemon.limb_model._segment_model import SegmentModel
from jointfit_daemon.limb_model._sensor_link import SensorLink

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Chain, Quaternion, Vector

Method = Literal["anchored", "patent12", "patent6", "markley", "mean", "single"]
"""Names of the fusion methods.

`calibration.soft_tissue.fit_segment` fits the models of these methods, and the help of `tools.fuse`
lists the names.
"""

Procedure = Literal["corrected", "patent"]
"""Steps of a calibration and of the fusion that uses it.

``patent`` uses only the published steps of the Chinese patent CN 114533039 B. It combines the
sensors of a segment by the patent's regression of quaternion components, without correction of
heading drift and without exclusion of faulty sensors. ``corrected`` includes the methods of this
project.
"""

SCHEMA = 1
"""Version of the JSON form; other versions are rejected."""


class CalibrationSchemaError(ValueError):
    """The JSON value is not a calibration, is incomplete, or has another schema version."""


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """Calibration of one sensor on its segment."""

    q_optical_world: Quaternion
    """Rotation from the world of the sensor to the optical world or, without cameras, to the static
    world.
    """
    q_sensor_segment: Quaternion
    """Sensor-to-segment alignment from the static pose."""
    lag_ns: int = 0
    """Sensor time stamp minus optical time stamp of the same event."""
    spread: float = 0.0
    """Robust standard deviation of the orientation during the static pose, rad."""


@dataclass(frozen=True, slots=True)
class SegmentCalibration:
    """Calibration of one segment, with one model for each set of available sensors."""

    q_static: Quaternion
    """q_optical_segment in the static pose."""
    length: float | None
    """Distance between the joint centers of the segment, m; None if unknown."""
    length_sd: float | None
    models: Mapping[str, SegmentModel] = field(default_factory=dict)
    """Models of the trained sets of sensors; `model_key` defines the keys."""


@dataclass(frozen=True, slots=True)
class CalibratedCenter:
    """Center of rotation of one joint from the calibration movement alone, in the static world."""

    center: Vector
    """Position of the center, m."""
    covariance: tuple[Vector, Vector, Vector]
    """Covariance of the center, m², which is 0 along `unseen`. Residuals from soft-tissue artefact
    repeat with posture, so all frames together count as one observation of the artefact.
    """
    unseen: tuple[Vector, ...]
    """Unit directions along which the movement did not determine the center."""


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """Calibration of one joint center."""

    center: Vector | None
    """Position in the optical world during the static pose, m."""
    sd: float | None
    """Standard deviation of the position (root mean variance per axis), m."""
    source: str
    """Source of the center: ``fit`` (movement), ``length`` (neighboring center and configured
    length), ``midpoint`` (middle between two joints) or ``unknown``.
    """
    residual_rms: float | None = None
    """RMS residual of the center, m. It is the deviation of the distances of the markers from their
    means. For the estimators ``score`` and ``sara``, it is the distance between the positions of
    the center that follow from the two body parts.
    """
    gap_rms: float | None = None
    """RMS distance over the movement between two points, m: the center as a fixed point of the
    proximal body part, and the center as a fixed point of the distal body part.
    """
    rotation: CalibratedCenter | None = None
    """Center from the calibration movement, with which later estimates are compared. None if one
    side of the joint has no markers.
    """


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration of one limb of one subject."""

    method: Method
    joints: tuple[str, ...]
    segments: tuple[str, ...]
    chain_sensors: tuple[tuple[str, ...], ...]
    sensor: Mapping[str, SensorCalibration]
    segment: Mapping[str, SegmentCalibration]
    joint: Mapping[str, JointCalibration]
    clusters: Mapping[str, StoredCluster] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    """Flags that every LimbState repeats, such as ``headings_from_static`` and ``facing_unknown``.
    """
    notes: tuple[str, ...] = ()
    """Notes for the operator on missing quantities, with remedies."""
    quality: Mapping[str, Any] = field(default_factory=dict)
    digest: str = ""
    """SHA-256 of the arrays of the trials."""
    software: str = ""
    created_utc: str = ""
    links: tuple[SensorLink, ...] = ()
    """Expected relations between sensors; empty without a recorded movement."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """Error correlation of the two segments at each inner joint, from `joint_error_correlations`.
    """
    memory: str = ""
    """Training frames for online learning, encoded by ``calibration.soft_tissue.pack``."""
    procedure: Procedure = "corrected"
    """Procedure of the calibration. With ``patent``, every segment has only one model, which uses
    all its sensors.
    """
    chain: RefinedChain | None = None
    """Refined markers of the chain model; None if there are none."""
    parents: tuple[int | None, ...] = ()
    """Number of the segment that is proximal to each joint, as in `Chain`; empty for a limb without
    branches.
    """
    left_joints: tuple[bool, ...] = ()
    """Whether each joint of a branched limb is on the left, as in `Chain`."""

    @property
    def lag_ns(self) -> dict[str, int]:
        """Lag of every sensor, ns."""
        return {name: sensor.lag_ns for name, sensor in self.sensor.items()}

    def fits(self, chain: Chain) -> bool:
        """Return whether segments, joints, sensors and branches agree with a chain."""
        mine = (self.joints, self.segments, self.chain_sensors, self.parents, self.left_joints)
        other = (chain.joints, chain.segments, chain.sensors, chain.parents, chain.left_joints)
        return mine == other

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, which consists of dicts, lists, numbers, strings and None.

        For a limb without branches, the keys of branches are absent, as in earlier versions.
        """
        form = {"schema": SCHEMA, **fields_form(self)}
        for key in ("parents", "left_joints"):
            if not form[key]:
                del form[key]
        return form

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Calibration:
        """Return the calibration from its JSON form.

        Raises
        ------
        CalibrationSchemaError
            The value is not a calibration, is incomplete, or has another schema version.
        """
        if data.get("schema") != SCHEMA:
            raise CalibrationSchemaError(
                f"schema {data.get('schema')!r}, this program reads {SCHEMA}"
            )
        if type(data["schema"]) is not int:
            raise CalibrationSchemaError(f"schema {data['schema']!r}, expected a whole number")
        try:
            return _from_dict(data)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise CalibrationSchemaError(
                f"not a calibration: {type(error).__name__}: {error}"
            ) from error


class ChainFields(TypedDict):
    """Fields of a calibration that identify its chain; `Calibration.fits` compares them."""

    joints: tuple[str, ...]
    segments: tuple[str, ...]
    chain_sensors: tuple[tuple[str, ...], ...]
    parents: tuple[int | None, ...]
    left_joints: tuple[bool, ...]


def chain_fields(chain: Chain) -> ChainFields:
    """Return the fields of a calibration that identify its chain."""
    return {
        "joints": chain.joints,
        "segments": chain.segments,
        "chain_sensors": chain.sensors,
        "parents": chain.parents,
        "left_joints": chain.left_joints,
    }


def model_key(sensors: Sequence[str], other: str | None) -> str:
    """Return the key of a model, from the available sensors of the segment and of its neighbor."""
    return f"{'+'.join(sensors)}|{other or ''}"


def _from_dict(data: Mapping[str, Any]) -> Calibration:
    correlations = {name: float(rho) for name, rho in data.get("correlations", {}).items()}
    if wrong := [rho for rho in correlations.values() if not -1.0 < rho < 1.0]:
        raise ValueError(f"correlation {wrong[0]}, expected a value between -1 and 1")

    return Calibration(
        method=cast("Method", data["method"]),
        joints=tuple(data["joints"]),
        segments=tuple(data["segments"]),
        chain_sensors=tuple(tuple(group) for group in data["chain_sensors"]),
        sensor={
            name: SensorCalibration(
                as_quaternion(item["q_optical_world"]),
                as_quaternion(item["q_sensor_segment"]),
                int(item["lag_ns"]),
                float(item["spread"]),
            )
            for name, item in data["sensor"].items()
        },
        segment={
            name: SegmentCalibration(
                as_quaternion(item["q_static"]),
                item["length"],
                item["length_sd"],
                {key: SegmentModel.from_dict(model) for key, model in item["models"].items()},
            )
            for name, item in data["segment"].items()
        },
        joint={name: _joint(item) for name, item in data["joint"].items()},
        clusters={name: _cluster(item) for name, item in data["clusters"].items()},
        flags=tuple(data["flags"]),
        notes=tuple(data["notes"]),
        quality=dict(data["quality"]),
        digest=data["digest"],
        software=data["software"],
        created_utc=data["created_utc"],
        links=tuple(SensorLink.from_dict(link) for link in data.get("links", ())),
        correlations=correlations,
        memory=str(data.get("memory", "")),
        procedure=cast("Procedure", data.get("procedure", "corrected")),
        chain=None if data.get("chain") is None else _chain(data["chain"]),
        parents=tuple(data.get("parents", ())),
        left_joints=tuple(data.get("left_joints", ())),
    )


def _chain(item: Mapping[str, Any]) -> RefinedChain:
    positions = {name: vector(position) for name, position in item["positions"].items()}
    return RefinedChain(item["model"], item["fingerprint"], positions)


def _joint(item: Mapping[str, Any]) -> JointCalibration:
    rotation = None
    if (found := item.get("rotation")) is not None:
        a, b, c = found["covariance"]
        rotation = CalibratedCenter(
            vector(found["center"]),
            (vector(a), vector(b), vector(c)),
            tuple(vector(direction) for direction in found["unseen"]),
        )
    return JointCalibration(
        None if item["center"] is None else vector(item["center"]),
        item["sd"],
        item["source"],
        item["residual_rms"],
        item["gap_rms"],
        rotation,
    )


def _cluster(item: Mapping[str, Any]) -> StoredCluster:
    return StoredCluster(
        tuple(item["markers"]),
        item["body"],
        tuple(vector(row) for row in item["template"]),
        vector(item["origin"]),
        as_quaternion(item["q_body"]),
    )
