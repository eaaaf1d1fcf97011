"""Compression of models: quantization and ``.neuprim`` files."""
