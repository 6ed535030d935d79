"""Named coordinates of a chain, computed instant by instant for publication by the daemon."""

from jointfit_daemon.kinematics.coordinate_tracking._tracker import CoordinateTracker

__all__ = ["CoordinateTracker"]
