"""Cameras (pinholes and other central projections), and readers of camera files."""

from neuprim.core.cameras.pinhole import (
    AnyCamera,
    Camera,
    CameraViews,
    RayCamera,
    check_viewmat,
    look_at,
    opengl_to_viewmat,
    orbit,
)

__all__ = ["AnyCamera", "Camera", "CameraViews", "RayCamera", "check_viewmat", "look_at", "opengl_to_viewmat", "orbit"]
