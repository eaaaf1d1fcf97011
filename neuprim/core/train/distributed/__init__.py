"""Data-parallel training: several processes (ranks) render different views of a step and end it with the same bits."""
