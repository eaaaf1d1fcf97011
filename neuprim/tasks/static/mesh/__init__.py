"""The scene ``mesh``: anybody's model, ray-cast as the built-in solids are.

``files`` reads the file and what it refers to, from its own folder alone; ``gltf`` and ``obj`` say what its materials
are; ``textures`` decodes their images; ``parts`` has trimesh read the geometry and places it; ``surface`` is what rays
meet; ``generate`` writes the data set.
"""

from neuprim.tasks.static.mesh.generate import load

__all__ = ["load"]
