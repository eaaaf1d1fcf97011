"""Hydra groups of the relighting task."""
