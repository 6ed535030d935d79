"""Virtual hardware: simulated sensors and cameras measure a known limb and send bytes."""
