"""Drivers open, configure and read devices: one package per device family, found by entry point."""

from jointfit_variant import select_variant

select_variant(__path__)
