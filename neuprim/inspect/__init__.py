"""Visual inspection of a model's density: volumes, isosurfaces, slices and primitives, next to the ground truth."""

from neuprim.inspect.field import InspectionFrame, parse_inspection_box

__all__ = ["InspectionFrame", "parse_inspection_box"]
