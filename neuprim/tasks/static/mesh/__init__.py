"""The scene ``mesh``: anybody's model, ray-cast as the built-in solids are.

``model`` reads files from the model's own folder; ``gltf``, ``obj`` and ``ply_stl`` parse them; ``materials`` resolves
colours and textures; ``surface`` is what rays meet; ``generate`` writes the data set.
"""

from neuprim.tasks.static.mesh.generate import load

__all__ = ["load"]
