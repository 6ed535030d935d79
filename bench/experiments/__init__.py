"""One package a topic; a module lists its experiments in ``EXPERIMENTS``."""
