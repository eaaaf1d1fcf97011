"""Hydra groups of the dynamic task."""
