"""Built-in solids for generated scenes: closed meshes, what a ray meets, and how a surface reflects a light.

Tasks that draw images of them bring their own light and cameras.
"""
