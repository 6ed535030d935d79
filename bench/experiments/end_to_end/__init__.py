"""Recorded trials sent as bytes through the daemon."""
