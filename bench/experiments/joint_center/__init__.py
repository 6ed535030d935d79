"""Experiments on functional joint centers in the plane and in space."""
