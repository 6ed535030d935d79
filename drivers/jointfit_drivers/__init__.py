"""Drivers open, configure and read devices: one package per device family, found by entry point."""
