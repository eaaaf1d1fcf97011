"""Layers in one OpenEXR file: what was given is there, by name, in the type asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from neuprim.core.errors import DataError
from neuprim.core.io.exr import Plane, write_layers
from neuprim.core.io.images import exr_channels, read_image


def test_layers_types_and_attributes_are_kept(tmp_path: Path) -> None:
    values = torch.rand(5, 7, 4) * 100 - 20
    planes = {
        "R": Plane(values[..., 0], True),
        "G": Plane(values[..., 1], True),
        "B": Plane(values[..., 2], True),
        "depth.Z": Plane(values[..., 3]),
    }
    said = {
        "worldToCamera": np.arange(16, dtype=np.float32).reshape(4, 4),
        "neuprim:run": "a run",
        "neuprim:near": 0.25,
    }
    write_layers(tmp_path / "a.exr", planes, said)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header, stored = dict(file.header()), {name: np.array(c.pixels) for name, c in file.channels().items()}
    assert {name: str(pixels.dtype) for name, pixels in stored.items()} == {
        **dict.fromkeys("RGB", "float16"),
        "depth.Z": "float32",
    }
    assert np.array_equal(stored["depth.Z"], values[..., 3].numpy()) and np.array_equal(
        stored["G"], values[..., 1].half().numpy()
    )
    assert (
        np.array_equal(header["worldToCamera"], said["worldToCamera"])
        and header["neuprim:run"] == "a run"
        and header["neuprim:near"] == 0.25
    )
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert exr_channels(tmp_path / "a.exr") == ("B", "G", "R", "depth.Z")
    assert torch.equal(read_image(tmp_path / "a.exr"), values[..., :3].half()), "the unprefixed channels are the image"


@pytest.mark.parametrize(
    ("planes", "words"),
    [
        ({}, r"shapes \[\]; expected one \(H, W\)"),
        ({"R": Plane(torch.zeros(2, 3)), "G": Plane(torch.zeros(3, 2))}, r"shapes .*; expected one \(H, W\)"),
        (
            {"R": Plane(torch.zeros(2, 3)), "depth.Z": Plane(torch.tensor([[0, 0, 0], [0, torch.inf, 0]]))},
            "channel depth.Z: value inf at row 1, column 1",
        ),
        ({"R": Plane(torch.full((2, 3), 7e4), True)}, r"channel R: value 70000 does not fit 16-bit floats"),
    ],
)
def test_what_a_file_cannot_hold_leaves_the_old_one(tmp_path: Path, planes: dict[str, Plane], words: str) -> None:
    path = tmp_path / "a.exr"
    path.write_text("old")
    with pytest.raises(DataError, match=words):
        write_layers(path, planes)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
