"""Drivers: open, configure and read devices; one module each, found by entry point."""
