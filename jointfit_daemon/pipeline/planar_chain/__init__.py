"""Joints and stick figure of a planar movement, from single markers on the segments."""

from jointfit_daemon.pipeline.planar_chain._planar_tracker import PlanarTracker

__all__ = ["PlanarTracker"]
