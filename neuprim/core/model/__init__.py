"""Primitives: their parameters, the closed forms that fields lower to, and the built-in fields."""
