"""Marker clusters of body parts as they were in the static pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion
if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.model import Quaternion, Vector
if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


@dataclass(frozen=True, slots=True)
class Cluster:
    """One body part as it stood in the static pose."""

    name: str
    markers: tuple[str, ...]
    """Names in the stream; empty where a rigid body stands for the part."""
    body: str | None
    """Name of the rigid body in the stream, or None."""
    template: Array
    """Marker positions minus `origin`, static world, m, shape (k, 3). A rigid body has four
    virtual points 0.1 m around its origin, so that every later step is the same for both."""
    origin: Array
    """Centroid of the markers (or origin of the body), static world, m, shape (3,)."""
    q_body: Array
    """q_static-world_body of the rigid body; the identity for markers."""


@dataclass(frozen=True, slots=True)
class StoredCluster:
    """Markers of one body part as they stood in the static pose; see `markers.Cluster`."""

    markers: tuple[str, ...]
    body: str | None
    template: tuple[Vector, ...]
    origin: Vector
    q_body: Quaternion


def vector(values: Iterable[Any]) -> Vector:
    """Return three numbers as a plain tuple of floats."""
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def stored_cluster(cluster: Cluster) -> StoredCluster:
    """Return a cluster as plain data."""
    return StoredCluster(
        cluster.markers,
        cluster.body,
        tuple(vector(row) for row in cluster.template),
        vector(cluster.origin),
        as_quaternion(cluster.q_body),
    )


def live_cluster(name: str, stored: StoredCluster) -> Cluster:
    """Return a cluster from plain data."""
    return Cluster(
        name,
        stored.markers,
        stored.body,
        np.array(stored.template),
        np.array(stored.origin),
        np.array(stored.q_body),
    )
