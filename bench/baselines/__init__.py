"""Estimators that only comparisons need."""
