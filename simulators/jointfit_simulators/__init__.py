"""Virtual hardware: moves a limb of known geometry, and sends real bytes of its devices."""
