"""Named coordinates of a chain, computed instant by instant, as the daemon publishes them."""

from jointfit_daemon.kinematics.coordinate_tracking._tracker import CoordinateTracker

__all__ = ["CoordinateTracker"]
