"""Hydra config groups of the task ``dynamic``."""
