"""Code that loaders of posed image files share: settings, splits, damaged views, and assembly of the data set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, ParamSpec, TypeVar

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset, PointCloud, StartingPoints, camera_extent
from neuprim.core.data.dataset import SceneContext, choose_dataset_world, dataset_focus_point
from neuprim.core.data.image_views import ImageFrame, ImageViews
from neuprim.core.data.initial import initial_points
from neuprim.core.errors import ConfigError, DataError, warn_once
from neuprim.core.io.images import ImageInfo
from neuprim.core.validation import Range, nonempty_text, validate_fields

Background = Literal["auto", "white", "black", "random"]

__all__ = ["FolderSettings", "SceneDetails", "assemble_dataset", "find_data_folder", "find_image"]
__all__ += ["split_every_nth", "unique_view_names"]

EveryNth = Annotated[int, Range(at_least=2)]  # every n-th image is held out
HoldOut = Annotated[int, Range(at_least=2, also=(0,))]  # the same, or 0 to use the data set's own test split
SplitName = Annotated[str, nonempty_text("the name in transforms_NAME.json")]


@dataclass(frozen=True)
class FolderSettings:
    """Settings that all loaders of folders with posed images share."""

    path: Annotated[Path, nonempty_text("the data set's folder")]  # folder of the data set, ``~`` allowed
    # "auto" (white for data with alpha, else black), "white", "black", or "random" (random in training, white in
    # evaluation)
    background: Background = "auto"
    downsample: Annotated[int, Range(at_least=1)] = 1  # integer factor by which images are reduced (area filter)
    preload: bool = True  # decode all images at once, so that damaged files are found before training
    strict: bool = False  # refuse a damaged view; otherwise it is left out with a warning

    def __post_init__(self) -> None:
        validate_fields(self, "scene")


def find_data_folder(path: str | Path) -> Path:
    """Return the folder of the setting ``path``, ``~`` expanded; raises DataError if it does not exist."""
    expected = "expected the data set's folder (scene.path)"
    try:
        folder = Path(path).expanduser()
        if folder.is_dir():
            return folder
        found = "is a file" if folder.exists() else "does not exist"
    except (OSError, RuntimeError) as error:  # a name that is too long, a home folder that nobody has
        raise DataError(f"{path}: {error}; {expected}") from None
    raise DataError(f"{folder}: {found}; {expected}")


_P = ParamSpec("_P")
_T = TypeVar("_T")


class BadImageViews:
    """Collector of the errors of damaged views.

    Damaged views are left out with a warning; if ``strict``, the first error is raised instead.
    """

    def __init__(self, where: str, strict: bool) -> None:
        self._where, self._strict = where, strict
        self._faults: list[str] = []

    def read(self, name: str, function: Callable[_P, _T], *args: _P.args, **more: _P.kwargs) -> _T | None:
        """Return ``function(*args, **more)`` for the view ``name``; None if it raises DataError, which is recorded."""
        try:
            return function(*args, **more)
        except DataError as error:
            self.add(name, error)
            return None

    def add(self, name: str, error: DataError) -> None:
        """Record a bad view; raise its error if ``strict``."""
        if self._strict:
            raise error
        self._faults.append(f"{error}; view {name} is left out (scene.strict=true refuses it)")
        if len(self._faults) == 1:
            self._first = error

    def settle(self, count: int) -> None:
        """Warn of all recorded bad views; raise DataError if more than half of all ``count`` views are bad."""
        bad = len(self._faults)
        if 2 * bad > count:
            more = "" if count == 1 else f"; {bad} of {count} views of {self._where} are faulty; expected at most half"
            raise DataError(f"{self._first}{more}")
        for fault in self._faults[:_LISTED]:
            warn_once(fault)
        if bad > _LISTED:
            warn_once(f"{self._where}: {bad - _LISTED} further views are left out for such faults")


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".PNG", ".JPG", ".JPEG", ".WEBP", ".EXR")
_LISTED = 10


class MissingFiles(DataError):
    """Error: files that a data set names do not exist."""


def find_image(folder: Path, text: str) -> Path | None:
    """Return the path of the image file ``text`` in ``folder``; None if there is no such file.

    The suffix of ``text`` may be missing, and upper and lower case may differ.
    """
    text = str(folder / text.replace("\\", "/"))
    try:
        found = next((Path(text + s) for s in ("", *IMAGE_SUFFIXES) if Path(text + s).is_file()), None)
        return found or _find_image_in_other_case(folder, Path(text))
    except OSError:  # a name longer than the file system can hold
        return None


def _warn_of_images_outside_dataset(where: str, home: Path, paths: Iterable[Path]) -> None:
    """Warn once of images outside of the data set's folder.

    Such images are read nevertheless, because other tools write such paths.
    """
    own = home.resolve()
    own = own if own.is_dir() else own.parent
    outside = [path for path in paths if not path.resolve().is_relative_to(own)]
    if outside:
        found = f"{len(outside)} of its images lie outside of {own}, the first {outside[0].resolve()}"
        warn_once(f"{where}: {found}; neuprim reads these images, too")


def _find_image_in_other_case(folder: Path, path: Path) -> Path | None:
    """Return the file below ``folder`` whose path equals ``path`` except for case; None if there is not exactly one."""
    if not path.is_relative_to(folder):
        return None
    for part in path.relative_to(folder).parts:
        if part != ".." and folder.is_dir() and not (folder / part).exists():
            alike = [p.name for p in folder.iterdir() if p.name.casefold() == part.casefold()]
            part = alike[0] if len(alike) == 1 else part
        folder = folder / part
    return folder if folder.is_file() else None


def exif_hint(info: ImageInfo) -> str:
    """Return a hint to append to a message about an image size if EXIF turns the image by 90 degrees, else ""."""
    if info.orientation < 5:
        return ""
    return (
        f"; EXIF orientation {info.orientation} rotates this image in other programs, but neuprim and COLMAP read the "
        "pixels as stored: give w, h of the stored pixels, or save the image rotated and without this EXIF entry"
    )


def missing_dataset_files_error(where: str, names: Sequence[str], hint: str = "") -> MissingFiles:
    """Return one error for all missing files of a data set; its message names the first ten."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return MissingFiles(f"{where}: {len(names)} files not found: {', '.join(names[:_LISTED])}{more}{hint}")


def unique_view_names(paths: Iterable[str], where: str) -> list[str]:
    """Return a view name for each image path: the path's stem (file name without suffix).

    If stems repeat, the names are the whole paths without suffix, with ``_`` for ``/``. If these repeat, too, the index
    of the image is put in front. Raises DataError if a path occurs twice.
    """
    texts = [p.replace("\\", "/").removeprefix("./") for p in paths]
    # bytes that are not UTF-8 are lone surrogates in a path, which cannot be written in other files
    texts = [t.encode("utf-8", "backslashreplace").decode() for t in texts]
    path, count = max(Counter(texts).items(), key=lambda item: item[1], default=("", 0))
    if count > 1:
        raise DataError(f"{where}: image {path!r} is listed {count} times; expected once")
    stems = [_drop_image_suffix(p.rstrip("/").rsplit("/", 1)[-1]) for p in texts]
    if len(set(stems)) < len(stems):
        stems = [_drop_image_suffix(p.strip("/")).replace("/", "_") for p in texts]
    if len(set(stems)) < len(stems):  # a_b.png beside a/b.png, or b.png beside b.jpg
        stems = [f"{i:04d}_{s}" for i, s in enumerate(stems)]
    return stems


def _drop_image_suffix(text: str) -> str:
    return next((text.removesuffix(s) for s in IMAGE_SUFFIXES if text.endswith(s)), text)


def split_every_nth(frames: Sequence[ImageFrame], n: int) -> tuple[list[ImageFrame], list[ImageFrame]]:
    """Return (training, test) frames: every n-th frame, beginning with the first, is a test frame."""
    return [f for i, f in enumerate(frames) if i % n], list(frames[::n])


@dataclass(frozen=True)
class SceneDetails:
    """Properties of a scene that a format provides besides its images."""

    up: Tensor | None = None  # (3,) upward direction; None for the mean of the cameras' upward directions
    points: PointCloud | None = None  # starting points of the format, float64 in the coordinates of the file
    prefix: str = ""  # reduction that the files already have, e.g. "images_4"
    start: StartingPoints | None = None  # None: initial_points, which draws from points or infers from static images
    to_linear: bool = False  # convert sRGB files to linear light
    exposure: float | Callable[[ImageViews], float] = 1.0  # divisor of linear values, or a function that finds it
    extra: object = None  # value of Dataset.extra
    positions: Sequence[str] = ()  # conditions that are positions, float64 in the coordinates of the file
    home: Path | None = None  # folder of the data set; None for the argument ``where`` of assemble_dataset


def assemble_dataset(
    where: str,
    name: str,
    train: Sequence[ImageFrame],
    test: Sequence[ImageFrame],
    settings: FolderSettings,
    context: SceneContext,
    details: SceneDetails = SceneDetails(),
) -> Dataset:
    """Make a Dataset of the given training and test frames.

    Args:
        where: file or folder that errors name.
        details: properties of the scene that its file format provides besides the images.

    Raises:
        DataError: an empty split, mixed kinds of images, or most images damaged; with ``settings.strict``, any damaged
            image.
        ConfigError: a random background without alpha, or a down-sampling factor larger than an image.
    """
    _check_dataset_splits(where, train, test, settings)
    both = [*train, *test]
    _warn_of_images_outside_dataset(where, details.home or Path(where), [frame.path for frame in both])
    background = _choose_dataset_background(where, settings.background, alpha=both[0].info.channels == 4)
    world = choose_dataset_world([f.camera for f in both], where) if context.world is None else context.world
    train, test = ([image_frame_in_scene(f, world, details.positions) for f in frames] for frames in (train, test))
    points = None if details.points is None else details.points.within(world)
    factor = settings.downsample
    views = [ImageViews(frames, factor, to_linear=details.to_linear) for frames in (train, test)]
    if settings.preload:
        at_rest = details.start is None  # scenes that move may show nothing at some moments
        _preload_split(where, views[0], "training", settings.strict, not at_rest, context.progress)
        _preload_split(where, views[1], "test", settings.strict, True, context.progress)
    exposure = details.exposure(views[0]) if callable(details.exposure) else details.exposure
    for images in views:
        images.scale = 1.0 / exposure
    cameras = [views[0].view(i).camera for i in range(len(views[0]))]
    reductions = [details.prefix, _describe_dataset_downsampling(both, views[0].view(0).camera, factor)]
    return Dataset(
        name=name,
        train=views[0],
        test=views[1],
        start=details.start or (lambda views, count, generator: initial_points(views, points, count, generator)),
        extent=camera_extent(cameras),
        color_space="linear" if details.to_linear or both[0].info.linear else "srgb",
        background=torch.full((3,), 0.0 if background == "black" else 1.0),
        random_background=background == "random",
        downsampling=", then ".join(text for text in reductions if text) or "none",
        up=_mean_dataset_up(cameras) if details.up is None else details.up,
        center=dataset_focus_point(cameras).float(),
        exposure=exposure,
        world=world,
        extra=details.extra,
    )


def _check_dataset_splits(
    where: str, train: Sequence[ImageFrame], test: Sequence[ImageFrame], settings: FolderSettings
) -> None:
    for split, frames in (("training", train), ("test", test)):
        if not frames:
            hint = ""
            if len(train) + len(test) == 1:
                hint = "; the scene has one image, but needs at least two: one for training and one for testing"
            elif split == "test" and hasattr(settings, "hold_out"):
                hint = "; scene.hold_out=8 holds out every 8th training view instead"
            raise DataError(f"{where}: the {split} split has no images; expected at least one{hint}")
    first = train[0]
    for frame in (*train, *test):
        if frame.info.linear != first.info.linear:
            found = f"images mix OpenEXR (linear) and PNG/JPEG (sRGB), see {first.path}"
            raise DataError(f"{frame.path}: {found}; expected only OpenEXR, or only PNG and JPEG")
        if frame.info.channels != first.info.channels:
            found = f"image has {frame.info.channels} channels, but {first.path} has {first.info.channels}"
            raise DataError(f"{frame.path}: {found}; expected only RGB images, or only RGBA images")
    trained = {frame.path.resolve() for frame in train}
    shared = [frame.path.name for frame in test if frame.path.resolve() in trained]
    if shared:
        found = f"{len(shared)} of {len(test)} test images are training images, too, e.g. {shared[0]}"
        warn_once(f"{where}: {found}; their quality says nothing about new views")


def _choose_dataset_background(where: str, background: str, alpha: bool) -> str:
    if background == "random" and not alpha:
        found = f"the images in {where} have no alpha"
        raise ConfigError(f"scene.background is 'random', but {found}; expected auto, white or black")
    return ("white" if alpha else "black") if background == "auto" else background


def _preload_split(
    where: str, images: ImageViews, split: str, strict: bool, empty: bool, progress: Callable[[str, float], None]
) -> None:
    """Decode all images of a split and leave out damaged images.

    Unless ``empty``, fully transparent images count as damaged.
    """
    bad = BadImageViews(f"{where} ({split})", strict)
    faults = images.preload(lambda fraction: progress(f"reading {split} images", fraction), empty)
    for index, error in faults.items():
        bad.add(images.view(index).name, error)
    bad.settle(len(images))
    images.drop(faults)


def image_frame_in_scene(frame: ImageFrame, world: World, positions: Sequence[str]) -> ImageFrame:
    """Convert a frame's camera, and the conditions named in ``positions``, from world to scene coordinates."""
    moved = {name: world.scene_points(frame.conditions[name]).float() for name in positions}
    return replace(frame, camera=world.scene_camera(frame.camera), conditions={**frame.conditions, **moved})


def _describe_dataset_downsampling(frames: Sequence[ImageFrame], reduced: Camera, factor: int) -> str:
    """Describe how images are reduced: "200x200 from 800x800 by area", "1/4 by area" if sizes differ, "" for none."""
    if factor == 1:
        return ""
    sizes = {(f.info.width, f.info.height) for f in frames}
    if len(sizes) > 1:
        return f"1/{factor} by area"
    width, height = sizes.pop()
    return f"{reduced.width}x{reduced.height} from {width}x{height} by area"


def _mean_dataset_up(cameras: Sequence[Camera]) -> Tensor:
    """Return the (3,) mean of the cameras' upward directions as a unit vector; +z if the directions cancel."""
    up = -torch.stack([c.viewmat[1, :3] for c in cameras]).mean(0)
    if up.norm() < 1e-3:
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return (up / up.norm()).float()
