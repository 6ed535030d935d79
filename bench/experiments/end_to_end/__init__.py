"""Experiments that send recorded trials as bytes through the daemon."""
