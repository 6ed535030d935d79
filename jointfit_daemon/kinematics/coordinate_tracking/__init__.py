"""Named coordinates of a chain at one instant after the other, as the daemon publishes them."""

from jointfit_daemon.kinematics.coordinate_tracking._tracker import CoordinateTracker

__all__ = ["CoordinateTracker"]
