"""What generated scenes share: closed meshes, what a ray meets, how a surface reflects a light, and how images become a
data set on disk.

Tasks bring their own light and cameras, and say what an image consists of: :class:`~neuprim.scenes.image_set.ImageSet`.
"""
