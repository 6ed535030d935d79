"""Drivers open, configure and read devices: one package a device family, found by entry point."""
