"""The built-in scene ``lit_solids``: the solids and a glossy ring on a slab, under one point light per image; needs no
download.

``scene`` says what stands there, ``rig`` where cameras and lights are, ``shading`` what a ray sees, ``generate`` writes
the data set and ``dataset`` reads it.
"""

from neuprim.tasks.relight.lit.dataset import load

__all__ = ["load"]
