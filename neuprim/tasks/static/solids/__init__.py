"""The built-in scene ``solids``: a power drill and small things with sharp edges, thin parts and smooth curves; needs no download.

``shapes`` and ``meshes`` say what there is, ``raycast`` what a ray meets, ``shading`` how it is lit, ``generate`` writes the data set.
"""

from neuprim.tasks.static.solids.generate import load

__all__ = ["load"]
