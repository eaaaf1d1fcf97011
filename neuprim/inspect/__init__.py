"""Look inside a density: volumes, isosurfaces, slices and primitives of a run, beside the ground truth."""

from neuprim.inspect.field import FieldFrame, ViewOptions, parse_box

__all__ = ["FieldFrame", "ViewOptions", "parse_box"]
