"""Estimators that serve as baselines only."""
