"""Images of five bands from a folder: OpenEXR or .npy files, a mask each where there is one, and cameras.json.

cameras.json is a transforms.json whose frames also say "file_path", "wavelength_shift" and perhaps "mask_path"; every
eighth frame is held out.
"""

import json
from pathlib import Path

import numpy as np
import torch

from neuprim.core.cameras.camera_files import read_cameras
from neuprim.core.data import Dataset, Pixels, View, ViewSet, camera_extent
from neuprim.core.data.initial import initial_points
from neuprim.core.data.posed_images import find_data_folder
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.images import read_image, read_mask_image
from neuprim_spectral.bands import BANDS


class FileViews(ViewSet):
    def __init__(self, frames):
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def view(self, index):
        return self.frames[index][0]

    def pixels(self, index):
        view, path, mask = self.frames[index]
        size = (view.camera.width, view.camera.height)
        return Pixels(_read(path, size), None, read_mask_image(mask, size) if mask else None)


def files(path, test_every):
    if not isinstance(test_every, int) or test_every < 2:
        raise ConfigError(f"scene.test_every={test_every}: expected a whole number of at least 2")
    folder = find_data_folder(path)
    frames = _frames(folder)
    train = [f for i, f in enumerate(frames) if i % test_every]
    if not train:
        raise DataError(f"{folder / 'cameras.json'}: {len(frames)} frames; expected at least 2")
    return Dataset(
        name=folder.name,
        train=FileViews(train),
        test=FileViews(frames[::test_every]),
        start=lambda views, count, generator: initial_points(views, None, count, generator),
        extent=camera_extent([view.camera for view, *_ in train]),
        background=torch.zeros(len(BANDS)),
        channels=len(BANDS),
        color_space="linear",
    )


def _frames(folder):
    where = folder / "cameras.json"
    cameras = read_cameras(where)
    frames = []
    for index, (record, (name, camera)) in enumerate(
        zip(json.loads(where.read_text())["frames"], cameras, strict=True)
    ):
        shift = record.get("wavelength_shift")
        if not isinstance(shift, int | float) or not 0 <= shift <= 1:
            raise DataError(f"{where}: frame {index}: wavelength_shift is {shift!r}; expected a number from 0 to 1")
        path = folder / str(record.get("file_path"))
        if not path.is_file():
            raise DataError(f"{where}: frame {index}: no file {path}")
        mask = folder / record["mask_path"] if "mask_path" in record else None
        frames.append((View(name, camera, {"wavelength_shift": torch.tensor(float(shift))}), path, mask))
    return frames


def _read(path: Path, size):
    """(H, W, 5) float32."""
    if path.suffix != ".npy":
        return read_image(path, size, channels=BANDS).float()
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}") from error
    expected = (size[1], size[0], len(BANDS))
    if values.shape != expected or values.dtype.kind != "f":
        raise DataError(f"{path}: {values.dtype} {values.shape}; expected numbers of shape {expected}")
    return torch.from_numpy(values).float()
