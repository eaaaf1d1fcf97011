"""Look inside a density: volumes, isosurfaces, slices and primitives of a run, beside the ground truth."""

from neuprim.inspect.field import InspectionFrame, parse_inspection_box

__all__ = ["InspectionFrame", "parse_inspection_box"]
