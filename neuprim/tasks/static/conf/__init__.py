"""Hydra config groups of the task ``static``. (Hydra searches for config groups in packages.)"""
