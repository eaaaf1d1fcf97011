"""Looking inside a density field: volumes, isosurfaces, slices and primitives of a run, beside the ground truth where
there is one."""

from neuprim.inspect.field import FieldFrame, ViewOptions
from neuprim.inspect.frames import corners

__all__ = ["FieldFrame", "ViewOptions", "corners"]
