"""Functional joint centers in the plane and in space."""
