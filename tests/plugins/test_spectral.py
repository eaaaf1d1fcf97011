"""A task of five channels, from the data to the report: what is shown is said, what is written is everything, what
cannot be is refused."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console
from torch import Tensor

import neuprim.runs.evaluate as finishing
from neuprim.cli.progress import RunProgress
from neuprim.conformance import check_task
from neuprim.core import checkpoint
from neuprim.core.channels import read_stored_channels
from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.io import images
from neuprim.core.io.exr import exr_channels
from neuprim.core.render import render
from neuprim.export import mesh, shared
from neuprim.plugins.registry import load_task
from neuprim.runs.export import export_run, import_run_directory
from neuprim.runs.inspect import InspectRequest, inspect_run
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, load_run, read_metrics
from neuprim.runs.render_images import RenderRequest, render_run
from tests.inspect.pages import array, layers_of
from tests.plugins.fakes import site
from tests.plugins.spectral import NAMES, fit, forget, install_spectral

__all__ = ["site"]

SHOWN = "450nm, 550nm, 650nm of 5 channels as red, green, blue"
SHIFT = {"wavelength_shift": "0"}
THROUGH = ", ".join(NAMES) + " through the display of task 'spectral'"


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finishing, "_ORBIT_FRAMES", 3)
    monkeypatch.setattr(shared, "_SIZE", 48)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run of the task with its display."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("spectral")
        (folder / "site").mkdir()
        patch.syspath_prepend(str(folder / "site"))
        patch.setattr(finishing, "_ORBIT_FRAMES", 3)
        install_spectral(folder / "site")
        yield fit(folder / "run")
        forget()


def changed(site: Path, tmp_path: Path, *words: str, **changes: str) -> tuple[Path, str]:
    """A run of a task with other lines in its TaskSpec, and what the console said."""
    install_spectral(site, **changes)
    console = Console(file=io.StringIO(), width=200)
    with RunProgress("spectral", console) as events:
        out = fit(tmp_path / "run", *words, events=events)
    return out, console.file.getvalue()  # type: ignore[attr-defined]


def first_view(run_dir: Path) -> tuple[Any, Tensor, Tensor]:
    """Channels of the model, rendered and true image of the first test view."""
    stored = load_run(run_dir)
    config, task, model, header = stored.config, stored.task, stored.model, stored.header
    dataset = load_dataset(stored)
    view = dataset.test.view(0)
    with torch.no_grad():
        drawn = render(model, view.camera, view.conditions, config.renderer, dataset.background).rgb
    return read_stored_channels(run_dir, header, task, 5), drawn, dataset.test.pixels(0).over(dataset.background)


# ---------------------------------------------------------------- with a display


def test_the_task_is_sound(trained: Path) -> None:
    check_task(load_task("spectral"))


def test_pictures_show_what_the_display_says(trained: Path) -> None:
    channels, drawn, truth = first_view(trained)
    display = load_task("spectral").display
    assert display is not None
    for path, values in (("test_000_view0.png", drawn), ("test_000_view0_truth.png", truth)):
        picture = images.read_image(trained / "renders" / path)
        assert torch.equal(picture, images.to_uint8(display(values))) and picture.float().std() > 20
        assert (picture.int() - images.to_uint8(values[..., :3]).int()).abs().max() > 50, "not the first three channels"
    with Image.open(trained / "renders" / "orbit.webp") as film:
        assert getattr(film, "n_frames", 1) == 3 and np.asarray(film.convert("RGB")).std() > 20
    assert channels.names == NAMES


def test_metrics_and_report_name_the_channels(trained: Path) -> None:
    found = read_metrics(trained)
    assert found["channels"] == list(NAMES) and found["shown"] == THROUGH
    assert not {"psnr_srgb", "ssim_srgb"} & found.keys()
    channels, drawn, truth = first_view(trained)
    shown, wanted = channels.display(drawn).double(), channels.display(truth).double()
    assert found["per_view"][0]["psnr_display"] == pytest.approx(
        -10 * torch.log10((shown - wanted).square().mean()).item(), abs=1e-4
    )
    assert found["ssim_display"] > 0.3
    page = (trained / "report.html").read_text()
    assert page.count(f"hown: {THROUGH.replace(chr(39), '&#x27;')}") == 2, "at the orbit and at the held-out views"
    assert "<dt>channels</dt><dd>450nm, 550nm, 650nm, 750nm, 850nm</dd>" in page
    assert "mean absolute difference over all channels" in page
    again = evaluate_run(trained)
    assert {k: again[k] for k in ("psnr", "ssim", "psnr_display", "channels",
        "shown")} == {k: found[k] for k in ("psnr", "ssim", "psnr_display", "channels", "shown")}  # fmt: skip


def test_exr_and_npy_hold_every_channel(trained: Path, tmp_path: Path) -> None:
    _, drawn, _ = first_view(trained)
    exr, other = render_run(
        trained, RenderRequest("test", format="exr", out=tmp_path / "exr", frames=1, layers="beauty")
    )
    assert (images.read_image(exr, channels=NAMES) - drawn).abs().max() < 1e-6 and exr != other
    npy = render_run(trained, RenderRequest("test", format="npy", out=tmp_path / "npy", frames=1))
    assert [p.name for p in npy] == ["view0.npy", "view1.npy"]
    values = np.load(npy[0], allow_pickle=False)
    assert values.dtype == np.float32 and values.shape == (24, 24, 5) and np.array_equal(values, drawn.numpy())
    assert render_run(trained, RenderRequest("orbit", out=tmp_path / "one.npy", frames=1)) == [tmp_path / "one.npy"]
    with pytest.raises(ConfigError, match=r"2 views do not fit one \.npy file"):
        render_run(trained, RenderRequest("orbit", out=tmp_path / "two.npy", frames=2))


def test_the_inspectors_page_has_the_displays_colours(trained: Path, tmp_path: Path) -> None:
    said: list[str] = []
    inspect_run(
        InspectRequest(trained, ("primitives",), grid=8, out=tmp_path / "page.html"),
        lambda event: said.append(event.text),
    )
    (frame,) = layers_of(tmp_path / "page.html")["frames"]
    (shown,) = (layer for layer in frame["layers"]["primitives"]["model"] if layer["kind"] == "ellipsoids")
    found = array(frame, shown["rows"], "<f4").reshape(-1, 15)[:, 12:]
    stored = load_run(trained)
    task, model = stored.task, stored.model
    assert task.display is not None
    values = model.params["logit"].sigmoid()
    raw = (values[:, :-1] + values[:, 1:]) / 2  # as a shift of 0.5 has it
    wanted = task.display(raw[None])[0].detach().numpy()
    assert len(found) and all(np.abs(wanted - row).max(1).min() < 2e-3 for row in found), "in 8 bits"
    assert not any(line.startswith("shown") for line in said)


def test_a_meshs_colours_go_through_the_display(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    import trimesh

    colour = torch.tensor([0.1, 0.2, 0.3, 0.6, 0.8])
    header, tensors = checkpoint.read_tensors(trained / "model.safetensors", "model")
    (tmp_path / "config.yaml").write_text((trained / "config.yaml").read_text())
    painted = {
        **tensors,
        "logit": torch.cat([colour, colour[:1]]).logit().expand(len(tensors["logit"]), 6).contiguous(),
    }
    rest = {k: v for k, v in header.items() if k not in ("format", "kind")}
    checkpoint.write_tensors(tmp_path / "model.safetensors", "model", painted, rest)
    report = export_run(tmp_path, "mesh", tmp_path / "m.ply", ["grid=32", "--wavelength_shift=0"])
    assert f"colours: {THROUGH}" in report.notes
    ball = trimesh.load(report.files[0], force="mesh", process=False)
    display = load_task("spectral").display
    assert display is not None
    wanted = display(colour[None, None])[0, 0]
    found = np.asarray(ball.visual.vertex_colors)[:, :3] / 255
    assert len(found) > 100 and np.abs(found - wanted.numpy()).max() <= 0.5 / 255 + 1e-6


def test_whole_models_keep_every_channel(trained: Path, tmp_path: Path) -> None:
    for name in ("npz", "ply"):
        back = import_run_directory(export_run(trained, name, tmp_path / f"m.{name}").files[0], tmp_path / name)
        (exr,) = render_run(back, RenderRequest("orbit", format="exr", out=tmp_path / f"{name}_out", frames=1))
        (own,) = render_run(trained, RenderRequest("orbit", format="exr", out=tmp_path / "own", frames=1))
        every = exr_channels(own)
        assert exr_channels(exr) == every and len(every) == 8
        assert torch.equal(images.read_image(exr, channels=every), images.read_image(own, channels=every))


def test_gaussians_of_five_channels_are_refused_before_any_is_fitted(
    trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuprim.export.gaussian_ply.fit_export_harmonics", lambda *a: pytest.fail("too late"))
    with pytest.raises(
        ConfigError,
        match=r"5 channels, 450nm, .*; this format stores red, green and blue; --format ply and npz hold all",
    ):
        export_run(trained, "gaussian-ply", words=["--wavelength_shift=0"])


def test_a_damaged_header_is_the_files_fault(trained: Path, tmp_path: Path) -> None:
    header, tensors = checkpoint.read_tensors(trained / "model.safetensors", "model")
    (tmp_path / "config.yaml").write_text((trained / "config.yaml").read_text())
    rest = {k: v for k, v in header.items() if k not in ("format", "kind")}
    checkpoint.write_tensors(tmp_path / "model.safetensors", "model", tensors, {**rest, "channels": ["a"]})
    with pytest.raises(CheckpointError, match=r"header names the channels \['a'\]; expected 5"):
        render_run(tmp_path, RenderRequest("orbit", format="png", frames=1))


# ---------------------------------------------------------------- without one


def test_without_a_display_it_is_said_what_is_shown(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, said = changed(site, tmp_path, display="None")
    assert f"shown: {SHOWN}; task 'spectral' has no display that shows them all" in said
    assert f"Shown: {SHOWN}." in (out / "report.html").read_text()
    _, _, truth = first_view(out)
    picture = images.read_image(out / "renders" / "test_000_view0_truth.png")
    assert torch.equal(picture, images.to_uint8(images.linear_to_srgb(truth[..., :3])))
    assert not {"psnr_srgb", "psnr_display"} & read_metrics(out).keys()
    lines: list[str] = []
    render_run(out, RenderRequest("orbit", format="png", out=tmp_path / "png", frames=1), notify=lines.append)
    assert lines == [f"shown: {SHOWN}; --format exr and npy hold all channels"]
    render_run(out, RenderRequest("orbit", format="exr", out=tmp_path / "exr", frames=1), notify=lines.append)
    assert len(lines) == 1
    request = InspectRequest(out, ("primitives",), grid=8, out=tmp_path / "page.html")
    inspect_run(request, lambda event: lines.append(event.text))
    assert f"shown: {SHOWN}" in lines
    monkeypatch.setattr(mesh, "_sample_exported_density", lambda *a: pytest.fail("too late"))
    with pytest.raises(ConfigError, match=r"5 channels, .* and task 'spectral' has no display that makes these"):
        export_run(out, "mesh", words=["--wavelength_shift=0"])


@pytest.mark.parametrize(("count", "space"), [(1, "linear"), (31, "srgb")])
def test_any_number_of_channels_runs_and_is_written(site: Path, tmp_path: Path, count: int, space: str) -> None:
    words = (f"scene.bands={count}", f"scene.space={space}", "train.iterations=5")
    out, said = changed(site, tmp_path, *words, display="None", channels="()")
    names = ("Y",) if count == 1 else tuple(f"c{i}" for i in range(count))
    found = read_metrics(out)
    assert found["channels"] == list(names) and ("shown" in found) == ("shown:" in said) == (count > 1)
    assert np.isfinite(found["psnr"]) and np.isfinite(found["ssim"]) and "psnr_srgb" not in found
    (npy,) = render_run(out, RenderRequest("orbit", format="npy", out=tmp_path / "npy", frames=1))
    (exr,) = render_run(out, RenderRequest("orbit", format="exr", out=tmp_path / "exr", frames=1, layers="beauty"))
    values, read = torch.from_numpy(np.load(npy)), images.read_image(exr, channels=names)
    assert torch.allclose(
        read, values if space == "linear" else images.srgb_to_linear(values.clamp_min(0.0)), atol=1e-6, rtol=1e-6
    )
    assert torch.isfinite(read).all() and read.std() > 0


def test_a_grey_model_is_exported_as_grey(site: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    import trimesh

    out, _ = changed(site, tmp_path, "scene.bands=1", display="None", channels="()")
    report = export_run(out, "gaussian-ply", tmp_path / "g.ply", ["views=orbit", "--wavelength_shift=0"])
    assert report.errors["psnr"] > 15
    rows = trimesh.load(tmp_path / "g.ply").metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(rows["f_dc_0"], rows["f_dc_2"]) and np.array_equal(rows["f_rest_0"], rows["f_rest_15"])
    assert rows["f_dc_0"].std() > 0
    ball = trimesh.load(
        export_run(out, "mesh", tmp_path / "m.ply", ["grid=32", "--wavelength_shift=0"]).files[0], process=False
    )
    colours = np.asarray(ball.visual.vertex_colors)[:, :3]
    assert (colours == colours[:, :1]).all() and colours.std() > 0
