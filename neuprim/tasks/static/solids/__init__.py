"""The built-in scene ``solids``: a power drill and small things with sharp edges, thin parts and smooth curves; needs
no download.

What there is and what a ray meets stands in :mod:`neuprim.scenes`; ``shading`` lights it, ``generate`` writes the data
set.
"""

from neuprim.tasks.static.solids.generate import load

__all__ = ["load"]
