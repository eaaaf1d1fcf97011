"""The built-in scene ``room``: the solids on a table in a textured room, taken like photographs; needs no download.

``layout`` says what stands where and ``textures`` how it looks, made of ``patterns``; ``scene`` is what rays meet,
``shading`` lights it;
``path`` and ``lens`` are the cameras, ``points`` what a reconstruction would find, ``generate`` writes the data set.
"""

from neuprim.tasks.static.room.generate import load

__all__ = ["load"]
