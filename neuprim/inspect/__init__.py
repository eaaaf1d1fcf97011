"""Look inside a density: volumes, isosurfaces, slices and primitives of a run, beside the ground truth."""

from neuprim.inspect.field import InspectionFrame, ViewOptions, parse_inspection_box

__all__ = ["InspectionFrame", "ViewOptions", "parse_inspection_box"]
