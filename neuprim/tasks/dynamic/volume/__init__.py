"""From OpenVDB grids to ground-truth images: optics (grids to a medium of light), and rays integrated cell by cell."""

from neuprim.tasks.dynamic.volume.looks import EMBERGEN_FIRE, LOOKS, named_look
from neuprim.tasks.dynamic.volume.march import integrate
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.normalise import Normalisation
from neuprim.tasks.dynamic.volume.optics import Light, Look, medium_of
from neuprim.tasks.dynamic.volume.rig import rig

__all__ = [
    "EMBERGEN_FIRE",
    "LOOKS",
    "Light",
    "Look",
    "Medium",
    "Normalisation",
    "integrate",
    "medium_of",
    "named_look",
    "rig",
]
