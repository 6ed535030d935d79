"""Marker clusters of body parts in the static pose, as arrays and as stored data.

The *static world* is the optical world as it was during the static pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector


@dataclass(frozen=True, slots=True)
class MarkerCluster:
    """Markers of one body part in the static pose."""

    name: str
    markers: tuple[str, ...]
    """Marker names in the stream; empty for a rigid body."""
    body: str | None
    """Name of the rigid body in the stream, or None."""
    template: Array
    """Marker positions minus `origin`, static world, m, shape (k, 3). A rigid body has four virtual
    points 0.1 m around its origin, so that the same code processes markers and rigid bodies.
    """
    origin: Array
    """Centroid of the markers or origin of the rigid body, static world, m, shape (3,)."""
    q_body: Array
    """Rotation from the rigid body to the static world; the identity for markers."""


@dataclass(frozen=True, slots=True)
class StoredCluster:
    """Plain data of a `MarkerCluster` in a calibration."""

    markers: tuple[str, ...]
    body: str | None
    template: tuple[Vector, ...]
    origin: Vector
    q_body: Quaternion


def vector(values: Iterable[Any]) -> Vector:
    """Return three numbers as a tuple of floats."""
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def cluster_record(cluster: MarkerCluster) -> StoredCluster:
    """Return a cluster as plain data."""
    return StoredCluster(
        cluster.markers,
        cluster.body,
        tuple(vector(row) for row in cluster.template),
        vector(cluster.origin),
        as_quaternion(cluster.q_body),
    )


def restore_cluster(name: str, stored: StoredCluster) -> MarkerCluster:
    """Return a stored cluster as arrays."""
    return MarkerCluster(
        name,
        stored.markers,
        stored.body,
        np.array(stored.template),
        np.array(stored.origin),
        np.array(stored.q_body),
    )
