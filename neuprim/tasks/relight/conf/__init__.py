"""Hydra config groups of the task ``relight``."""
