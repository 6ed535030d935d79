"""Wire formats without I/O: codecs for drivers and simulators, one package per device family."""

from jointfit_variant import select_variant

select_variant(__path__)
