"""Drivers that open, configure and read devices: one package per device family."""

from jointfit_variant import select_variant

select_variant(__path__)
