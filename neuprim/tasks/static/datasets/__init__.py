"""Loaders of posed photographs and renders: one module per format, each with ``load(settings, context) -> Dataset``."""
