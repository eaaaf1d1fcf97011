"""Read intrinsics, lenses and other keys of ``transforms.json`` files, for loaders of data sets and of cameras.

Focal lengths: ``fl_x fl_y`` in pixels, ``camera_angle_x camera_angle_y`` in radians, ``x_fov y_fov`` in degrees, or
``camera_intrinsics`` [cx, cy, fx, fy]. Principal point: ``cx cy``. Size: ``w h``. Lens: ``camera_model``,
``is_fisheye``, ``k1 k2 k3 k4 p1 p2``.

A *record* is the JSON object of a frame or of the whole file. A *group* is a set of keys with one purpose: the focal
length, the principal point, the lens model or the distortion.

* All keys of a group come from the frame if the frame has any key of the group, else from the file.
* Keys of one record that state the same quantity must agree within 1 %.
* Lengths in pixels refer to the image size in their own record. Lengths are scaled if the image is a resized copy.
* A DataError reports a key that changes the image and that neuprim cannot apply. A warning lists unknown keys.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from neuprim.core.cameras.pinhole import Camera, opengl_to_viewmat
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader

# pinholes but for radial and tangential distortion
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_intrinsics")
PRINCIPAL_POINT = ("cx", "cy")
SIZE = ("w", "h")

_TOLERANCE = 0.01
_SHORTEST = 0.5 / math.tan(math.radians(85))  # least focal length over image side: no pinhole photograph shows more

Say = Callable[[str], None]


@dataclass(frozen=True)
class CameraTarget:
    """The image for which a camera is read: an image file, or an image to render."""

    width: int
    height: int
    image: str = ""  # path of the image file; empty for an image to render
    hint: str = ""  # text to append to messages about the image size

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


@dataclass(frozen=True)
class _IntrinsicsSource:
    """A record with intrinsics (a frame or the whole file), and the image size to which the record's lengths refer."""

    record: JsonReader
    size: tuple[int, int]

    def has(self, group: tuple[str, ...]) -> bool:
        return any(self.record.has(key) for key in group)

    def scales(self, keys: str, target: CameraTarget) -> tuple[float, float]:
        """Return (x, y) factors that convert lengths from pixels of this record to pixels of the target image.

        ``keys`` names the lengths in errors. Raises DataError unless this record's image size and the target image have
        the same aspect ratio.
        """
        if not is_resized_camera_size(self.size, target.size):
            own, other = _format_camera_image_size(self.size), _format_camera_image_size(target.size)
            found = f"{keys} are for images of {own} (w, h), but the image is {other}"
            expected = f"{keys} in the frame, together with its w, h{target.hint}"
            raise DataError(f"{self.record.where}: {found}; expected {expected}")
        return target.width / self.size[0], target.height / self.size[1]


def _format_camera_image_size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def is_resized_camera_size(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two image sizes (width, height) have the same aspect ratio, up to rounding to whole pixels."""
    scale = max(other[0] / size[0], other[1] / size[1])
    return abs(size[0] * scale - other[0]) <= 1.0 and abs(size[1] * scale - other[1]) <= 1.0


def _record_with_camera_keys(group: tuple[str, ...], frame: JsonReader, file: JsonReader) -> JsonReader:
    """Return the record that has the keys of a group: the frame if it has any key of the group, else the file."""
    return frame if any(frame.has(key) for key in group) else file


def read_camera(
    frame: JsonReader,
    file: JsonReader,
    target: CameraTarget,
    viewmat: Tensor | None = None,
    say: Say = lambda text: None,
) -> Camera:
    """Read the pinhole camera of a frame; keys that the frame lacks are read from ``file``.

    ``file`` is the JSON object of the whole file, ``target`` the image of the camera. ``viewmat`` (4, 4) is the
    world-to-camera matrix, OpenCV axes; None reads the field ``transform_matrix``. The function calls ``say`` with
    messages for the user. Raises DataError for missing or wrong fields, or fields that contradict each other or the
    size of the image.
    """
    of_file = _IntrinsicsSource(file, _stated_image_size(file, target.size))
    of_frame = _IntrinsicsSource(frame, _stated_image_size(frame, of_file.size))
    if target.image and of_frame.size != target.size:
        stated, image = _format_camera_image_size(of_frame.size), _format_camera_image_size(target.size)
        if not is_resized_camera_size(of_frame.size, target.size):
            where = _record_with_camera_keys(SIZE, frame, file).where
            expected = f"{stated} (w, h in {where}) or a reduction of it"
            raise DataError(f"{target.image}: image is {image}; expected {expected}{target.hint}")
        say(f"{file.where}: w, h are {stated} and the image {image}; cameras are scaled to the images")
    focal = of_frame if of_frame.has(FOCAL) else of_file
    fx, fy = _read_focal_lengths(frame, focal, target, say)
    cx, cy = _read_principal_point(of_frame, of_file, focal, target)
    if focal is of_frame:
        _check_one_lens(of_frame, of_file, target)
    if viewmat is None:
        viewmat = opengl_to_viewmat(frame.matrix("transform_matrix"))
    return Camera(viewmat, fx, fy, cx, cy, target.width, target.height)


def _stated_image_size(record: JsonReader, default: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) from the keys w and h of a JSON object; ``default`` replaces missing keys."""
    return record.count("w") if record.has("w") else default[0], record.count("h") if record.has("h") else default[1]


# ---------------------------------------------------------------- focal lengths


def _read_focal_lengths(
    frame: JsonReader, level: _IntrinsicsSource, target: CameraTarget, say: Say
) -> tuple[float, float]:
    """Return (fx, fy) in pixels of the target image, from the record ``level``, which is the frame or the file.

    Raises DataError for missing, contradictory or implausible focal lengths.
    """
    x, y = _stated_camera_focal_lengths(level, 0, target), _stated_camera_focal_lengths(level, 1, target)
    if not x and not y:
        keys = "camera_angle_x (radians), fl_x (pixels), camera_intrinsics or x_fov (degrees)"
        raise DataError(f"{frame.where}: no focal length; expected {keys}, in the frame or in the file")
    fx, fy = (next(iter(found.values()), 0.0) for found in (x, y))
    fx, fy = fx or fy, fy or fx
    where, lengths = level.record.where, f"{fx:.5g} and {fy:.5g}"
    if min(fx / target.width, fy / target.height) < _SHORTEST:
        stated = f"focal lengths of {lengths} pixels on {_format_camera_image_size(target.size)}"
        raise DataError(
            f"{where}: {', '.join((*x, *y))} give {stated}, a field of view above 170 degrees; "
            "expected a pinhole camera, with lengths in pixels and not as fractions of the image size"
        )
    if not {*x, *y} & {"fl_x", "fl_y", "camera_intrinsics"} and not _focal_lengths_agree(fx, fy):
        keys = f"{next(iter(x))} and {next(iter(y))}"
        expected = "square pixels, or fl_x and fl_y. Leave out Blender's angle_y, which describes the sensor"
        raise DataError(
            f"{where}: {keys} give pixels that are not square, with focal lengths {lengths}; expected {expected}"
        )
    portrait = max(target.height / target.width, 1.0)
    for found, other in ((x, y), (y, x)):
        first, value = next(iter(found.items()), ("", 0.0))
        for key in found:
            if _focal_lengths_agree(found[key], value):
                continue
            text = f"{where}: {first} gives a focal length of {value:.5g} pixels, but {key} gives {found[key]:.5g}"
            # BlenderNeRF writes the angles of Blender's sensor beside the right fl_x and fl_y: angle_x is that of the
            # image's longer side, and angle_y has nothing to do with the image
            explained = key == "camera_angle_x" and _focal_lengths_agree(found[key] * portrait, value)
            explained |= (
                key == "camera_angle_y"
                and first == "fl_y"
                and _focal_lengths_agree(fx, fy)
                and "camera_angle_x" in other
            )
            if not explained:
                remedy = "remove the wrong one, or give w, h of the images that they are for"
                raise DataError(f"{text}; expected equal values within {_TOLERANCE:.0%}: {remedy}")
            say(f"{text}; {first} is taken")
    return fx, fy


def _stated_camera_focal_lengths(level: _IntrinsicsSource, axis: int, target: CameraTarget) -> dict[str, float]:
    """Return key -> focal length, for each key of a record that states the focal length along ``axis`` (0: x, 1: y).

    Focal lengths are in pixels of the target image. Keys in pixels come before keys that state a field of view.
    """
    record, name, side = level.record, "xy"[axis], target.size[axis]
    found = {}
    if record.has(key := f"fl_{name}"):
        length = record.number(key, "a focal length in pixels above 0", 0.0)
        found[key] = length * level.scales("fl_x, fl_y", target)[axis]
    if record.has(key := "camera_intrinsics"):
        found[key] = _read_camera_intrinsics(record)[2 + axis] * level.scales(key, target)[axis]
    for key, unit, expected in (
        (f"camera_angle_{name}", 1.0, "field of view in radians, between 0 and pi"),
        (f"{name}_fov", math.pi / 180.0, "field of view in degrees, between 0 and 180"),
    ):
        if record.has(key):
            angle = record.number(key, f"the {('horizontal', 'vertical')[axis]} {expected}", 0.0, math.pi / unit)
            found[key] = 0.5 * side / math.tan(0.5 * angle * unit)
    return found


def _read_camera_intrinsics(record: JsonReader) -> list[float]:
    """Return the key ``camera_intrinsics`` as [cx, cy, fx, fy] in pixels; raise DataError unless fx, fy > 0."""
    values: list[float] = record.array("camera_intrinsics", (4,), "[cx, cy, fx, fy] in pixels").tolist()
    if not (values[2] > 0 and values[3] > 0):
        expected = "[cx, cy, fx, fy] with focal lengths above 0"
        raise DataError(f"{record.where}: camera_intrinsics is {values}; expected {expected}")
    return values


def _focal_lengths_agree(a: float, b: float) -> bool:
    return abs(a - b) <= _TOLERANCE * max(abs(a), abs(b))


# ---------------------------------------------------------------- principal point


def _read_principal_point(
    frame: _IntrinsicsSource, file: _IntrinsicsSource, focal: _IntrinsicsSource, target: CameraTarget
) -> tuple[float, float]:
    """Return the principal point in pixels of the target image; without any key, it is the image centre.

    ``focal`` is the record that states the focal lengths, ``frame`` or ``file``.
    """
    array = focal.record.has("camera_intrinsics")
    level = frame if frame.has(PRINCIPAL_POINT) else focal if array else file
    array = array and level is focal
    if not array and not level.has(PRINCIPAL_POINT):
        return 0.5 * target.width, 0.5 * target.height
    record, keys = level.record, "camera_intrinsics" if array else "cx, cy"
    if level is frame and sum(record.has(key) for key in PRINCIPAL_POINT) == 1 and file.has(PRINCIPAL_POINT):
        found = "the frame has only one of cx, cy, and the cx, cy of the whole file are for another camera"
        raise DataError(f"{record.where}: {found}; expected both cx and cy in the frame")
    scale = level.scales(keys, target)
    plain = [record.number_or(key, 0.5 * side) for key, side in zip(PRINCIPAL_POINT, level.size, strict=True)]
    stated = _read_camera_intrinsics(record)[:2] if array else plain
    cx, cy = stated[0] * scale[0], stated[1] * scale[1]
    if array and level.has(PRINCIPAL_POINT):
        differences = (abs(cx - plain[0] * scale[0]), abs(cy - plain[1] * scale[1]))
        if any(d > _TOLERANCE * side for d, side in zip(differences, target.size, strict=True)):
            found = f"cx, cy are {plain}, but camera_intrinsics begins with {stated}"
            raise DataError(f"{record.where}: {found}; expected the same cx, cy in both")
    if target.image or not (frame.has(SIZE) or file.has(SIZE)):  # an image to render may have it outside
        _check_principal_point(record.where, keys, (cx, cy), frame.has(SIZE) or file.has(SIZE), target)
    return cx, cy


def _check_principal_point(
    where: str, keys: str, point: tuple[float, float], stated: bool, target: CameraTarget
) -> None:
    """Raise DataError for an implausible principal point (cx, cy) in pixels of the target image.

    A point is implausible if it lies outside the image, or if its values are fractions of the image size. ``stated``
    says whether the file states an image size. If not, a point that is the centre of an image of another size is
    implausible, too. Errors name the JSON object ``where`` and its ``keys``.
    """
    (cx, cy), image = point, f"{target.image or 'the picture'} ({target.width}x{target.height})"
    kx, ky = 2.0 * cx / target.width, 2.0 * cy / target.height
    if not stated and min(kx, ky) > 0.0 and abs(kx - 1.0) > 0.05 and abs(kx - ky) <= 2 * _TOLERANCE * kx:
        width, height = round(2 * cx), round(2 * cy)
        found = f"{keys} are {cx:g}, {cy:g}, the centre of an image of {width}x{height}, but the image is {image}"
        expected = f"w, h of the images to which lengths in pixels refer, e.g. {width}, {height}"
        raise DataError(f"{where}: {found}; expected {expected}")
    if max(cx, cy) <= 1.0 and min(target.width, target.height) > 8:
        raise DataError(f"{where}: {keys} are {cx:g}, {cy:g} on {image}; expected pixels, not fractions of the image")
    if not (0.0 < cx < target.width and 0.0 < cy < target.height):
        order = "the order [cx, cy, fx, fy]" if keys == "camera_intrinsics" else "a point in the image"
        found = f"{keys} put the principal point outside of {image}, at {cx:g}, {cy:g}"
        raise DataError(f"{where}: {found}; expected {order}")


# ---------------------------------------------------------------- lenses


def _check_one_lens(frame: _IntrinsicsSource, file: _IntrinsicsSource, target: CameraTarget) -> None:
    """Raise DataError if a frame mixes its own focal length with lens keys of the file for another focal length.

    The lens keys are the principal point and the distortion coefficients. A principal point at the image centre and
    zero coefficients fit every focal length, so they raise no error.
    """
    if file.record.has("camera_intrinsics") or not file.has(FOCAL):
        return
    left = []
    if not frame.has(PRINCIPAL_POINT) and not frame.record.has("camera_intrinsics"):
        sides = zip(PRINCIPAL_POINT, file.size, strict=True)
        left = [key for key, side in sides if abs(file.record.number_or(key, 0.5 * side) / side - 0.5) > _TOLERANCE]
    if not frame.has(COEFFICIENTS):
        left += [key for key in COEFFICIENTS if file.record.number_or(key, 0.0) != 0.0]
    if not left:
        return
    own, other = (
        [
            *_stated_camera_focal_lengths(level, 0, target).values(),
            *_stated_camera_focal_lengths(level, 1, target).values(),
        ][0]
        for level in (frame, file)
    )
    if not _focal_lengths_agree(own, other):
        found = f"has its own focal length, but {', '.join(left)} of the file are for another focal length"
        raise DataError(f"{frame.record.where}: {found}; expected {', '.join(left)} in the frame, too")


def read_lens_coefficients(frame: JsonReader, file: JsonReader) -> dict[str, float]:
    """Return the distortion coefficients k1 to k4, p1, p2 by name; a missing coefficient is 0.

    If the frame has any coefficient, all coefficients come from the frame, else from the file.
    """
    record = _record_with_camera_keys(COEFFICIENTS, frame, file)
    return {key: record.number_or(key, 0.0) for key in COEFFICIENTS}


def has_fisheye_lens(frame: JsonReader, file: JsonReader, others: tuple[str, ...] = ("OPENCV_FISHEYE",)) -> bool:
    """Return whether the lens is OpenCV's fisheye; raise DataError for a model that is neither fisheye nor pinhole.

    ``others`` are further lens models that the error message lists as valid.
    """
    record = _record_with_camera_keys(("camera_model", "is_fisheye"), frame, file)
    model = record.text("camera_model") if record.has("camera_model") else "OPENCV"
    fisheye = record.values.get("is_fisheye")
    if fisheye not in (None, False, True):  # 0 and 1 equal False and True
        raise record.fail("is_fisheye", "true or false")
    if model == "OPENCV_FISHEYE" or fisheye:
        return True
    if model not in MODELS:
        raise record.fail("camera_model", "one of " + ", ".join((*MODELS, *others)))
    return False


# keys that every loader reads, in the file or in a frame
_READ = {*FOCAL, *PRINCIPAL_POINT, *SIZE, *COEFFICIENTS}
_READ |= {"camera_model", "is_fisheye", "frames", "file_path", "transform_matrix", "mask_path"}

_HARMLESS = frozenset(
    # extents, starting values and switches of the training of other programs
    "aabb_scale aabb aabb_range render_aabb scale offset up sphere_center sphere_radius scene_scale scene_box "
    "near far bounds camera_near camera_far n_frames sharpen sharpness sharpness_discard_threshold "
    "importance_sampling n_extra_learnable_dims envmap orientation_override auto_scale_poses_override "
    "fps seconds "
    # poses and points are already in the frame that these lead to
    "applied_transform applied_scale "
    # depths and normals, which are not learned from
    "enable_depth_loading enable_ray_loading integer_depth_scale depth_unit_scale_factor depth_path depth_file_path "
    "normal_path normal_file_path "
    # names and numbers of images and cameras
    "colmap_im_id colmap_image_id camera_id camera_idx camera_index camera_label image_id img_id frame_id "
    "frame_index id index name rotation metadata aux_cam_params points timestamp camera_angle "
    # of scene=mesh, which reads them itself
    "rendered_from scene_from_file".split()
)

_RAYS = "a projection that is not supported; expected photographs of a pinhole camera, or an OPENCV_FISHEYE"
_LENS = "a lens distortion that is not supported; expected k1 to k4, p1, p2, or undistorted images"
_MOVES = "a camera that moves during the exposure; expected one transform_matrix, with images without rolling shutter"
_ALPHA = "transparency that is not supported; expected PNG images with an alpha channel"
_REFUSED = {
    **dict.fromkeys(
        "latlong equirectangular panorama ftheta ftheta_p0 ftheta_p1 ftheta_p2 ortho orthographic is_ortho "
        "ortho_scale fisheye".split(),
        _RAYS,
    ),
    **dict.fromkeys("k5 k6 s1 s2 s3 s4 sx1 sy1 b1 b2 skew sk_x sk_y".split(), _LENS),
    **dict.fromkeys(
        "distortion distortion_params distortion_coefficients dist_coeffs radial_distortion "
        "tangential_distortion".split(),
        _LENS,
    ),
    **dict.fromkeys(("rolling_shutter", "transform_matrix_start", "transform_matrix_end"), _MOVES),
    **dict.fromkeys("white_transparent black_transparent fix_premult alpha_path fg_mask_path".split(), _ALPHA),
    **dict.fromkeys(("shift_x", "shift_y"), "a shifted lens; expected cx, cy with the shift in them, and no shift"),
    "normal_mts_args": "Mitsuba's axes; expected OpenGL's, x right, y up, z backward",
    "from_na": "NeuS2's camera axes (OpenCV: y down, z forward); expected OpenGL's, x right, y up, z backward, and no "
    "from_na",
    "driver_parameters": "a light of its own in every frame; expected task=relight scene=olat, with pl_pos",
}
"""Map from each unsupported key that changes the image to what the key describes, for the error message."""

_KINDS = ("camera_type", "lens_model", "distortion_model", "projection")
_ELSEWHERE = {"time": "task=dynamic scene=multiview reads it", "pl_pos": "task=relight scene=olat reads it"}
_LISTED = 8


def refuse_unsupported_camera_keys(record: JsonReader) -> None:
    """Raise DataError for a key that changes the image and that neuprim does not support."""
    for key, states in _REFUSED.items():
        if key in record.values and _is_camera_key_set(record.values[key]):
            raise DataError(f"{record.where}: {key} describes {states}")
    pinholes = ("perspective", "persp", "none", *(m.lower() for m in MODELS))
    for key in _KINDS:
        if record.has(key) and str(record.values[key]).lower() not in pinholes:
            raise record.fail(key, "perspective (set camera_model to choose a lens)")
    frames = record.values.get("frames")
    if record.has("n_frames") and isinstance(frames, list) and record.count("n_frames") < len(frames):
        raise record.fail("n_frames", f"{len(frames)}, the number of frames; remove frames that should not be used")


def _is_camera_key_set(value: Any) -> bool:
    """Return whether a JSON value is set: not null, false, zero, empty, or a list of such values only."""
    return any(map(_is_camera_key_set, value)) if isinstance(value, list) else bool(value)


def describe_unknown_camera_keys(file: JsonReader, frames: Iterable[JsonReader], read: Iterable[str]) -> str:
    """Return a warning that lists unknown keys; "" if there are none.

    ``read`` are the keys that the loader itself reads, in addition to the keys of this module.
    """
    known = _READ | _HARMLESS | _REFUSED.keys() | {*_KINDS, *read}
    found = dict.fromkeys(k for k in file.values if k not in known)
    found.update(dict.fromkeys(f"frames[].{k}" for r in frames for k in r.values if k not in known))
    named = [k[:60] for k in found if not k.removeprefix("frames[].").startswith("_")]
    if not named:
        return ""
    more = f" and {len(named) - _LISTED} more" if len(named) > _LISTED else ""
    hints = [f"; {hint}" for key, hint in _ELSEWHERE.items() if f"frames[].{key}" in found]
    return f"{file.where}: keys that are not read: {', '.join(named[:_LISTED])}{more}{''.join(hints)}"
