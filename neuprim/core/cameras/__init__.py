"""Cameras: pinholes, other central projections, and files of them."""

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
