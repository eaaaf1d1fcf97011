"""What the keys of ``transforms.json`` files mean: those that are read, those that change nothing, and those that are
refused.

The keys are the ones that instant-ngp, nerfstudio, BlenderNeRF, NeRF-synthetic, D-NeRF, NRHints and GS³ write or read.
A key that changes the picture is read or refused by name; a key that nobody here knows is named once in a warning.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from neuprim.core.cameras.intrinsics import COEFFICIENTS, FOCAL, MIDDLE, MODELS, SIZE
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader

__all__ = ["READ", "check_keys", "unknown_keys"]

READ = frozenset(
    {
        *FOCAL,
        *MIDDLE,
        *SIZE,
        *COEFFICIENTS,
        "camera_model",
        "is_fisheye",
        "frames",
        "file_path",
        "transform_matrix",
        "mask_path",
    }
)
"""Keys that every loader reads, in the file or in a frame."""

_HARMLESS = frozenset(
    # extents, starting values and switches of the training of other programs
    "aabb_scale aabb aabb_range render_aabb scale offset up sphere_center sphere_radius scene_scale scene_box near far bounds "
    "camera_near camera_far n_frames sharpen sharpness sharpness_discard_threshold importance_sampling n_extra_learnable_dims "
    "envmap from_na orientation_override auto_scale_poses_override fps seconds "
    # poses and points are already in the frame that these lead to
    "applied_transform applied_scale "
    # depths and normals, which are not learned from
    "enable_depth_loading enable_ray_loading integer_depth_scale depth_unit_scale_factor depth_path depth_file_path "
    "normal_path normal_file_path "
    # names and numbers of images and cameras
    "colmap_im_id colmap_image_id camera_id camera_idx camera_index camera_label image_id img_id frame_id frame_index id index name "
    "rotation metadata aux_cam_params points timestamp camera_angle "
    # of scene=mesh, which reads them itself
    "rendered_from scene_from_file".split()
)

_RAYS = "another projection; expected photographs of a pinhole camera, or an OPENCV_FISHEYE"
_LENS = "a distortion that is not read; expected k1 to k4, p1, p2, or undistorted images"
_MOVES = "a camera that moves during the exposure; expected one transform_matrix, with images without rolling shutter"
_ALPHA = "what is transparent; expected PNG images with an alpha channel"
_REFUSED = {
    **dict.fromkeys(
        "latlong equirectangular panorama ftheta ftheta_p0 ftheta_p1 ftheta_p2 ortho orthographic is_ortho ortho_scale fisheye".split(),
        _RAYS,
    ),
    **dict.fromkeys("k5 k6 s1 s2 s3 s4 sx1 sy1 b1 b2 skew sk_x sk_y".split(), _LENS),
    **dict.fromkeys(
        "distortion distortion_params distortion_coefficients dist_coeffs radial_distortion tangential_distortion".split(),
        _LENS,
    ),
    **dict.fromkeys(("rolling_shutter", "transform_matrix_start", "transform_matrix_end"), _MOVES),
    **dict.fromkeys("white_transparent black_transparent fix_premult alpha_path fg_mask_path".split(), _ALPHA),
    **dict.fromkeys(("shift_x", "shift_y"), "a shifted lens; expected cx, cy with the shift in them, and no shift"),
    "normal_mts_args": "Mitsuba's axes; expected OpenGL's, x right, y up, z backward",
    "driver_parameters": "a light of its own in every frame; expected task=relight scene=olat, with pl_pos",
}
"""Keys that change the picture where they say something other than nothing, and what they state."""

_KINDS = ("camera_type", "lens_model", "distortion_model", "projection")
_ELSEWHERE = {"time": "task=dynamic scene=multiview reads it", "pl_pos": "task=relight scene=olat reads it"}
_LISTED = 8


def check_keys(record: JsonReader) -> None:
    """Refuse a record with a key that changes the picture and that nothing here honours.

    Raises:
        DataError: naming the key and what it states.
    """
    for key, states in _REFUSED.items():
        if key in record.values and _says(record.values[key]):
            raise DataError(f"{record.where}: {key} states {states}")
    for key in _KINDS:
        if record.has(key) and str(record.values[key]).lower() not in (
            "perspective",
            "persp",
            "none",
            *(m.lower() for m in MODELS),
        ):
            raise record.fail(key, "perspective (camera_model is read for lenses)")
    frames = record.values.get("frames")
    if record.has("n_frames") and isinstance(frames, list) and record.count("n_frames") < len(frames):
        raise record.fail("n_frames", f"{len(frames)}, as there are frames; take out those that should not count")


def _says(value: Any) -> bool:
    """Whether a value is more than zeros, false or nothing."""
    if isinstance(value, (list, tuple)):
        return any(map(_says, value))
    return bool(value)


def unknown_keys(file: JsonReader, frames: Iterable[JsonReader], read: Iterable[str]) -> str:
    """A line that names the keys that neither are read nor known to be harmless; "" for none."""
    known = READ | _HARMLESS | _REFUSED.keys() | {*_KINDS, *read}
    found = dict.fromkeys(k for k in file.values if k not in known)
    found.update(dict.fromkeys(f"frames[].{k}" for r in frames for k in r.values if k not in known))
    named = [k[:60] for k in found if not k.removeprefix("frames[].").startswith("_")]
    if not named:
        return ""
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    hints = [f"; {hint}" for key, hint in _ELSEWHERE.items() if f"frames[].{key}" in found]
    return f"{file.where}: keys that are not read: {', '.join(named[:_LISTED])}{more}{''.join(hints)}"
