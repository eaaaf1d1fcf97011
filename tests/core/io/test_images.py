"""Image files: what is read is what was written, and everything else is refused by name."""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.io.exr import COMPRESSIONS, REC709, ExrChannel, exr_channels, write_exr, write_exr_layers


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def refuse(path: Path, *words: str, size: tuple[int, int] | None = None) -> None:
    """Reading fails with the file's name and all of ``words``."""
    with pytest.raises(DataError) as caught:
        images.read_image(path, size)
    for word in (str(path), *words):
        assert word in str(caught.value)


def png(width: int, height: int, depth: int, kind: int, rows: bytes) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("channels", [3, 4])
def test_png_keeps_every_value(tmp_path: Path, channels: int) -> None:
    pixels = noise(5, 7, channels)
    images.write_png(tmp_path / "a.png", torch.from_numpy(pixels))
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), pixels)
    read = images.read_image(tmp_path / "a.png", (7, 5))
    assert read.dtype == torch.uint8 and np.array_equal(read.numpy(), pixels)
    assert images.image_info(tmp_path / "a.png") == images.ImageInfo(7, 5, channels, False)


def test_floats_are_rounded_and_clamped(tmp_path: Path) -> None:
    values = torch.tensor([[[-1.0, 0.0, 0.4 / 255], [0.6 / 255, 1.0, 2.0]]])
    images.write_png(tmp_path / "a.png", values)
    assert images.read_image(tmp_path / "a.png").flatten().tolist() == [0, 0, 0, 1, 255, 255]


def test_jpeg_by_content_not_by_name(tmp_path: Path) -> None:
    for shape in ((8, 8, 3), (8, 8)):
        Image.fromarray(np.full(shape, 100, np.uint8)).save(tmp_path / "a.png", format="JPEG")
        assert (images.read_image(tmp_path / "a.png").int() - 100).abs().max() <= 2


@pytest.mark.parametrize(("half", "dtype"), [(True, torch.float16), (False, torch.float32)])
def test_exr_is_linear_and_never_clamped(tmp_path: Path, half: bool, dtype: torch.dtype) -> None:
    values = torch.tensor([[[-2.0, 0.5, 1000.0, 0.25], [0.0, 1.5, 60000.0, 1.0]]])
    write_exr(tmp_path / "a.exr", values, half=half)
    read = images.read_image(tmp_path / "a.exr", (2, 1))
    assert read.dtype == dtype and torch.equal(read.float(), values)
    assert images.image_info(tmp_path / "a.exr") == images.ImageInfo(2, 1, 4, True)


def test_missing_empty_foreign_and_folder(tmp_path: Path) -> None:
    refuse(tmp_path / "none.png", "not found")
    for content, word in ((b"", "empty"), (b"no image", "expected PNG, JPEG, WebP or OpenEXR")):
        (tmp_path / "a.png").write_bytes(content)
        refuse(tmp_path / "a.png", word)
    for kind in ("BMP", "GIF", "TIFF"):
        Image.fromarray(noise(4, 4, 3)).save(tmp_path / "a.png", format=kind)
        refuse(tmp_path / "a.png", f"image is {kind}", "convert it")
    (tmp_path / "a.png").write_bytes(b"\0\0\0\x20ftypavif\0\0\0\0" + bytes(40))
    refuse(tmp_path / "a.png", "image is AVIF", "convert it")
    refuse(tmp_path, "cannot be read")


@pytest.mark.parametrize(("mode", "channels"), [("L", 3), ("P", 3), ("LA", 4), ("1", 3)])
def test_grey_and_palette_images_are_what_they_show(tmp_path: Path, mode: str, channels: int) -> None:
    image = Image.fromarray(noise(4, 6, 3)).convert(mode)
    image.save(tmp_path / "a.png")
    shown = np.asarray(image.convert("RGBA"))[..., :channels]
    assert np.array_equal(images.read_image(tmp_path / "a.png").numpy(), shown)
    assert images.image_info(tmp_path / "a.png") == images.ImageInfo(6, 4, channels, False)


def test_a_palette_with_transparent_colours_has_alpha(tmp_path: Path) -> None:
    Image.fromarray(noise(4, 6, 3)).convert("P").save(tmp_path / "a.png", transparency=bytes(range(256)))
    read = images.read_image(tmp_path / "a.png")
    assert read.shape == (4, 6, 4) and images.image_info(tmp_path / "a.png").channels == 4
    assert np.array_equal(read.numpy(), np.asarray(Image.open(tmp_path / "a.png").convert("RGBA")))


@pytest.mark.parametrize("channels", [3, 4])
def test_webp(tmp_path: Path, channels: int) -> None:
    pixels = np.concatenate([noise(5, 7, 3), np.full((5, 7, channels - 3), 200, np.uint8)], axis=-1)
    Image.fromarray(pixels).save(tmp_path / "a.webp", lossless=True)
    assert np.array_equal(images.read_image(tmp_path / "a.webp").numpy(), pixels)
    frames = [Image.fromarray(noise(5, 7, 3)), Image.fromarray(255 - noise(5, 7, 3))]
    frames[0].save(tmp_path / "b.webp", save_all=True, append_images=frames[1:])
    refuse(tmp_path / "b.webp", "animation", "expected one picture")


@pytest.mark.parametrize("orientation", [3, 6])
def test_exif_orientation_is_told_and_not_applied(tmp_path: Path, orientation: int) -> None:
    image = Image.fromarray(np.full((4, 6, 3), 100, np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.jpg", exif=exif)
    assert images.image_info(tmp_path / "a.jpg") == images.ImageInfo(6, 4, 3, False, orientation)
    assert images.read_image(tmp_path / "a.jpg").shape == (4, 6, 3)


def test_a_lack_of_memory_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images.write_png(tmp_path / "a.png", torch.zeros(4, 4, 3))

    def load(self: Image.Image) -> None:
        raise MemoryError

    monkeypatch.setattr("PIL.PngImagePlugin.PngImageFile.load", load)
    refuse(tmp_path / "a.png", "more memory than available")
    with pytest.raises(DataError, match=r"a\.png.*more memory"):
        images.read_mask_image(tmp_path / "a.png")


def test_what_8_bit_rgb_cannot_hold_is_refused(tmp_path: Path) -> None:
    for kind, size in ((0, 2), (2, 6), (6, 8)):
        (tmp_path / "a.png").write_bytes(png(2, 2, 16, kind, (b"\0" + bytes(2 * size)) * 2))
        refuse(tmp_path / "a.png", "16-bit", "expected 8-bit")
    Image.fromarray(noise(4, 4, 3)).convert("CMYK").save(tmp_path / "a.jpg")
    refuse(tmp_path / "a.jpg", "CMYK")
    Image.fromarray(noise(4, 4, 3)).save(tmp_path / "a.png", transparency=(1, 2, 3))
    refuse(tmp_path / "a.png", "colour key")


def test_wrong_size(tmp_path: Path) -> None:
    for write, name in ((images.write_png, "a.png"), (write_exr, "a.exr")):
        write(tmp_path / name, torch.zeros(4, 6, 3))
        refuse(tmp_path / name, "6x4", "expected 4x6", size=(4, 6))


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("side", [8200, 30_000, 2**31 - 1])
def test_bombs_are_refused_from_the_header(tmp_path: Path, side: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "_decode_image", lambda *a: pytest.fail("decoded"))
    (tmp_path / "a.png").write_bytes(png(side, side, 8, 2, b""))
    refuse(tmp_path / "a.png", "pixels")
    write_exr(tmp_path / "a.exr", torch.zeros(2, 2, 3))
    data = bytearray((tmp_path / "a.exr").read_bytes())
    for name in (b"dataWindow", b"displayWindow"):
        at = data.index(name + b"\0box2i\0") + len(name) + 11
        data[at : at + 16] = struct.pack("<4i", 0, 0, side - 1, side - 1)
    (tmp_path / "a.exr").write_bytes(data)
    refuse(tmp_path / "a.exr")


def test_exr_refusals(tmp_path: Path) -> None:
    def write(planes: dict[str, np.ndarray], **header: object) -> Path:
        OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, planes).write(str(tmp_path / "a.exr"))
        return tmp_path / "a.exr"

    plane = np.ones((4, 4), np.float32)
    refuse(write({"Y": plane}), "channels are Y", "expected R, G, B")
    refuse(write({"R": plane, "G": plane}), "expected R, G, B")
    refuse(write({f"{layer}.{c}": plane for layer in "ab" for c in "RGB"}), "of one layer")
    refuse(write({c: plane.astype(np.uint32) for c in "RGB"}), "uint32", "expected half or float")
    window = (np.array([0, 0], np.int32), np.array([9, 9], np.int32))
    refuse(write(dict.fromkeys("RGB", plane), displayWindow=window), "display window")
    bad = plane.copy()
    bad[2, 3] = np.nan
    refuse(write({"R": plane, "G": bad, "B": plane}), "nan", "row 2, column 3, channel 1")


def test_failed_writes_leave_the_old_file_and_no_rubbish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    images.write_png(path, torch.ones(2, 2, 3))
    before = path.read_bytes()
    with pytest.raises(DataError, match="NaN"):
        images.write_png(path, torch.full((2, 2, 3), float("nan")))
    with pytest.raises(DataError, match=r"shape \(2, 2\)"):
        images.write_png(path, torch.ones(2, 2))

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        for write in (images.write_png, write_exr, images.write_webp):
            with pytest.raises(DataError, match="No space left"):
                write(path, torch.zeros(2, 2, 3))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.png"]
    for write in (images.write_png, write_exr):
        with pytest.raises(DataError, match="cannot be written"):
            write(tmp_path / "no" / "a", torch.zeros(2, 2, 3))


def test_transfer_curve() -> None:
    # IEC 61966-2-1: mid-grey 0.5 is 0.21404 of linear light; the linear part ends at 0.04045 / 0.0031308
    srgb = torch.tensor([0.0, 0.04045, 0.5, 1.0], dtype=torch.float64)
    linear = torch.tensor([0.0, 0.0031308, 0.21404114, 1.0], dtype=torch.float64)
    assert torch.allclose(images.srgb_to_linear(srgb), linear, atol=1e-7)
    values = torch.linspace(-0.5, 4.0, 1001, dtype=torch.float64)
    assert torch.allclose(images.srgb_to_linear(images.linear_to_srgb(values)), values, atol=1e-6)
    x = torch.tensor([-0.1, 0.0, 0.002, 0.5, 3.0], dtype=torch.float64, requires_grad=True)
    for curve in (images.srgb_to_linear, images.linear_to_srgb):
        assert torch.autograd.gradcheck(curve, (x,))


def test_masks_are_colours_that_are_not_zero(tmp_path: Path) -> None:
    grey = Image.fromarray(np.array([[0, 1], [128, 255]], np.uint8))
    palette = Image.fromarray(np.array([[0, 1, 2]], np.uint8), "P")
    palette.putpalette([0, 0, 0, 255, 255, 255, 0, 0, 0])
    for image, expected in (
        (grey, [[False, True], [True, True]]),
        (grey.convert("RGB"), [[False, True], [True, True]]),
        (Image.fromarray(np.array([[[0, 0, 0, 255], [9, 0, 0, 200], [0, 0, 0, 0]]], np.uint8)), [[False, True, False]]),
        (palette, [[False, True, False]]),
        (Image.fromarray(np.array([[True, False]])), [[True, False]]),
    ):
        image.save(tmp_path / "m.png")
        assert images.read_mask_image(tmp_path / "m.png").tolist() == expected
    for mode in ("RGBA", "LA"):
        Image.new("RGBA", (2, 2), (255, 255, 255, 0)).convert(mode).save(tmp_path / "m.png")
        with pytest.raises(DataError, match=r"m.png: transparent pixels of the mask are not black; expected black"):
            images.read_mask_image(tmp_path / "m.png")
    (tmp_path / "m.png").write_bytes(png(2, 2, 16, 0, (b"\0" + bytes(4)) * 2))
    with pytest.raises(DataError, match="16-bit"):
        images.read_mask_image(tmp_path / "m.png")


def test_exr_of_other_primaries_is_told(tmp_path: Path) -> None:
    colors = {c: ExrChannel(torch.ones(2, 2)) for c in "RGB"}
    acescg = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
    for primaries in (REC709, acescg):
        write_exr_layers(tmp_path / "a.exr", colors, {"chromaticities": primaries})
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            images.read_image(tmp_path / "a.exr")
        told = ["other chromaticities than Rec. 709; colours are not converted" in str(w.message) for w in given]
        assert told == ([] if primaries == REC709 else [True])


def test_exr_of_one_named_layer(tmp_path: Path) -> None:
    planes = {f"View.{c}": np.full((2, 3), i, np.float32) for i, c in enumerate("RGB")}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(tmp_path / "a.exr"))
    assert images.read_image(tmp_path / "a.exr")[0, 0].tolist() == [0.0, 1.0, 2.0]


def test_exr_layers_keep_names_types_and_attributes(tmp_path: Path) -> None:
    values = torch.rand(5, 7, 4) * 100 - 20
    channels = {c: ExrChannel(values[..., i], half=True) for i, c in enumerate("RGB")}
    channels["depth.Z"] = ExrChannel(values[..., 3])
    attributes = {"worldToCamera": np.arange(16, dtype=np.float32).reshape(4, 4), "neuprim:run": "a", "neuprim:x": 0.25}
    write_exr_layers(tmp_path / "a.exr", channels, attributes)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header, stored = dict(file.header()), {name: np.array(c.pixels) for name, c in file.channels().items()}
    kinds = {name: str(pixels.dtype) for name, pixels in stored.items()}
    assert kinds == {**dict.fromkeys("RGB", "float16"), "depth.Z": "float32"}
    assert np.array_equal(stored["depth.Z"], values[..., 3].numpy())
    assert np.array_equal(stored["G"], values[..., 1].half().numpy())
    assert all(np.array_equal(header[key], value) for key, value in attributes.items())
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert exr_channels(tmp_path / "a.exr") == ("B", "G", "R", "depth.Z")
    assert torch.equal(images.read_image(tmp_path / "a.exr"), values[..., :3].half())


def test_a_data_window_around_what_is_visible(tmp_path: Path) -> None:
    values, visible = torch.rand(5, 7), torch.zeros(5, 7, dtype=torch.bool)
    visible[1, 3] = visible[3, 5] = True
    write_exr_layers(tmp_path / "a.exr", {"Y": ExrChannel(values)}, visible=visible)
    write_exr_layers(tmp_path / "empty.exr", {"Y": ExrChannel(values)}, visible=visible & False)
    for name, (x0, y0, x1, y1) in (("a.exr", (3, 1, 5, 3)), ("empty.exr", (0, 0, 0, 0))):
        with OpenEXR.File(str(tmp_path / name), separate_channels=True) as file:
            header, pixels = dict(file.header()), np.array(file.channels()["Y"].pixels)
        assert [c.tolist() for c in header["dataWindow"]] == [[x0, y0], [x1, y1]]
        assert [c.tolist() for c in header["displayWindow"]] == [[0, 0], [6, 4]]
        assert np.array_equal(pixels, values[y0 : y1 + 1, x0 : x1 + 1].numpy())


def test_dwaa_takes_no_colours_beyond_half_floats(tmp_path: Path) -> None:
    bright = ExrChannel(torch.full((4, 4), 1e5))
    write_exr_layers(tmp_path / "a.exr", {"depth.Z": bright}, compression="dwaa")
    with pytest.raises(DataError, match=r"channel fire\.R: value 100000 does not fit the compression dwaa"):
        write_exr_layers(tmp_path / "a.exr", {"fire.R": bright}, compression="dwaa")


@pytest.mark.parametrize("name", COMPRESSIONS)
def test_compressions_lose_nothing_but_dwaa(tmp_path: Path, name: str) -> None:
    ramp = torch.linspace(0, 1, 64).expand(64, 64) + 0.05 * torch.rand(64, 64)
    channels = {"R": ExrChannel(ramp), "depth.Z": ExrChannel(ramp)}
    write_exr_layers(tmp_path / "a.exr", channels, compression=name)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert file.header()["compression"] == COMPRESSIONS[name]
        found = {n: np.array(c.pixels) for n, c in file.channels().items()}
    assert np.array_equal(found["depth.Z"], ramp.numpy())
    assert (
        np.array_equal(found["R"], ramp.numpy()) == (name != "dwaa") and np.abs(found["R"] - ramp.numpy()).max() < 0.1
    )


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ({}, r"shapes \[\]"),
        ({"R": torch.zeros(2, 3), "G": torch.zeros(3, 2)}, "shapes"),
        ({"depth.Z": torch.tensor([[0, 0, 0], [0, torch.inf, 0]])}, "channel depth.Z: value inf at row 1, column 1"),
        ({"R": torch.full((2, 3), 7e4)}, "channel R: value 70000 does not fit"),
    ],
)
def test_impossible_exr_layers_leave_the_old_file(
    tmp_path: Path, channels: dict[str, torch.Tensor], words: str
) -> None:
    path = tmp_path / "a.exr"
    path.write_text("old")
    with pytest.raises(DataError, match=words):
        write_exr_layers(path, {name: ExrChannel(values, half=name == "R") for name, values in channels.items()})
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
