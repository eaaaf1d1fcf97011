"""Searches over settings and sizes: trade-offs, ablations, targets, pruning and compression."""
