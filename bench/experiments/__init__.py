"""Experiments, in one package per topic; a module lists its experiments in ``EXPERIMENTS``."""
