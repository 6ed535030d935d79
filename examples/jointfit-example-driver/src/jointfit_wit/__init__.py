"""WitMotion IMUs for jointfitd: a driver that lives outside of it."""
