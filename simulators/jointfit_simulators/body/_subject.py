"""Interface of a subject, simulated or recorded: base world (z up), m, rad."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from jointfit_simulators.body._orientation import Rotation


class GroundTruth(NamedTuple):
    """The bones at n instants."""

    orientations: Mapping[str, Rotation]
    """Each segment: segment coordinates to base world."""
    joints: Mapping[str, NDArray[np.float64]]
    """Center of each joint, m, shape (n, 3); NaN where unknown."""
    knee: NDArray[np.float64]
    """Flexion, adduction, internal rotation, rad, shape (n, 3); flexion brings the heel back."""
    included: NDArray[np.float64]
    """Inner angle of the knee, rad, shape (n,): pi when straight."""


class Observation(NamedTuple):
    """What there is to see in one block of time, each stream at its own instants."""

    sensors: Sequence[NDArray[np.float64]]
    """q_base_sensor of each sensor, mount and soft tissue included, shape (n, 4)."""
    markers: NDArray[np.float64]
    """Marker positions on the skin, m, shape (m, markers, 3); NaN where never recorded."""
    bones: Mapping[str, tuple[Rotation, NDArray[np.float64]]]
    """Orientation and origin (m) of bones that the cameras can see as bodies; else empty."""
    truth: GroundTruth


class InstrumentedSubject(Protocol):
    """Whoever wears the sensors."""

    @property
    def sensors(self) -> Mapping[str, str]:
        """Sensor ids and the segment each is worn on."""

    @property
    def clusters(self) -> Mapping[str, tuple[str, ...]]:
        """Markers of each body part, in the order of `Observation.markers`."""

    @property
    def templates(self) -> Mapping[str, NDArray[np.float64]]:
        """Markers of each rigid body in the body's own frame, m, shape (markers, 3)."""

    @property
    def visible_bones(self) -> tuple[str, ...]:
        """Segments whose bones the cameras stream as bodies: the reference of a recording."""

    @property
    def facts(self) -> Mapping[str, object]:
        """What does not change during the run, for the truth log; JSON values."""

    def play(self, name: str, t_s: float) -> None:
        """Begin another motion."""

    def motion_at(self, t_s: float) -> str:
        """Return the name of the motion at an instant."""

    def discard_before(self, t_s: float) -> None:
        """Promise never to ask about earlier instants again."""

    def observe(
        self,
        sensors: Sequence[NDArray[np.float64]],
        cameras: NDArray[np.float64],
        truth: NDArray[np.float64],
    ) -> Observation:
        """Return what is to be seen at the instants (s) of each sensor, the cameras, the log."""
