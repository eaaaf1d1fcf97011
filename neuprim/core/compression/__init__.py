"""Quantized models in ``.neuprim`` files."""
