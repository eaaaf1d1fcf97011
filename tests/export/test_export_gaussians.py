"""`neuprim export --format gaussian-ply`: the layout of 3D Gaussian splatting, moments that match, and images close to
the model's."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data.points_file import read_points
from neuprim.core.errors import ConfigError
from neuprim.core.io.ply import read_ply
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.edge import NORMS
from neuprim.core.model.geometry import quaternion_to_matrix
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.settings import ModelSettings
from neuprim.export.gaussian_ply import LAYOUT, SIZES, Gaussians, draw_exported_gaussians, fit_gaussians
from neuprim.export.shared import ExportHarmonics, fit_export_harmonics
from neuprim.plugins.registry import load_task
from neuprim.runs.export import export_run
from neuprim.runs.open import open_run
from tests.core import tiny
from tests.plugins import marked

pytestmark = pytest.mark.usefixtures("small_pictures")


def one_ellipsoid(tmp_path: Path, thickness: float = 6.0) -> Path:
    model = marked.static_model(neurons=0, degree=0)
    rows = {name: value[4:].clone() for name, value in model.params.items()}
    rows["log_scales"] = torch.tensor([[0.4, 0.2, 0.1]]).log()
    rows["quats"] = torch.tensor([[1.0, 0.5, -0.3, 0.2]])
    rows["b2"] = torch.full((1, 1), thickness)
    return marked.static_run(tmp_path / "one", Primitives(model.density, model.colour, rows))


def test_moments_of_a_constant_density_are_those_of_an_ellipsoid(tmp_path: Path) -> None:
    run = open_run(one_ellipsoid(tmp_path))
    g = fit_gaussians(run, {}, "moments")
    axes = quaternion_to_matrix(run.model.params["quats"].double())[0] * torch.tensor(
        [0.4, 0.2, 0.1], dtype=torch.float64
    )
    assert torch.allclose(g.means[0], torch.tensor([0.5, 0.7, 0.9], dtype=torch.float64), atol=1e-3)
    assert torch.allclose(g.covariances[0], axes @ axes.T / 5, rtol=0.02, atol=1e-4)
    expected = np.mean([1 - math.exp(-2 * 6.0 * s / 0.4) for s in (0.4, 0.2, 0.1)])
    assert float(g.opacities[0]) == pytest.approx(expected, rel=0.02)
    scales, quats = g.axes()
    R = quaternion_to_matrix(torch.from_numpy(quats))[0].numpy()
    assert np.allclose(R @ np.diag(scales[0] ** 2) @ R.T, g.covariances[0].numpy(), atol=1e-9) and np.linalg.det(R) > 0


def test_a_density_on_one_side_moves_the_mean_there(tmp_path: Path) -> None:
    model = marked.static_model(neurons=1, degree=0)
    rows = {name: value[:1].clone() for name, value in model.params.items()}
    rows["quats"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    rows["W1"], rows["b1"] = torch.tensor([[[0.0, 1 / 30, 0.0]]]), torch.tensor([[-math.pi / 2 / 30]])
    rows["w2"], rows["b2"] = torch.tensor([[5.0]]), torch.tensor([[0.0]])  # sigma ~ sin(y/m): none below the middle
    g = fit_gaussians(
        open_run(marked.static_run(tmp_path / "run", Primitives(CosineDensity(1), model.colour, rows))), {}, "moments"
    )
    assert abs(float(g.means[0, 0])) < 1e-6 and abs(float(g.means[0, 2])) < 1e-6 and 0.1 < float(g.means[0, 1]) < 0.2
    assert float(g.covariances[0, 1, 1]) < 0.5 * float(g.covariances[0, 0, 0])


@pytest.mark.parametrize(("edge", "faint", "solid"), [(0, 0.28, 0.41), (2, 0.11, 0.26)])
def test_the_profile_is_the_closest_bell_and_hides_as_much(
    tmp_path: Path, edge: int, faint: float, solid: float
) -> None:
    """A ball against its Gaussian on the screen, along an axis: RMS of what is left over that of alpha."""
    for i, (depth, bound) in enumerate(((0.1, faint), (3.0, solid))):
        model = marked.static_model(neurons=0, degree=0)
        rows = {name: value[4:].clone() for name, value in model.params.items()}
        rows |= {"log_scales": torch.full((1, 3), 0.4).log(), "b2": torch.full((1, 1), depth / NORMS[edge])}
        run = open_run(
            marked.static_run(tmp_path / f"{i}", Primitives(CosineDensity(0, edge=edge), model.colour, rows))
        )
        r = (torch.arange(600, dtype=torch.float64) + 0.5) / 300
        alpha = 1 - torch.exp(-depth * (1 - r * r).clamp_min(0) ** (edge + 0.5))
        errors, areas = {}, {}
        for size in SIZES:
            g = fit_gaussians(run, {}, size)
            bell = g.opacities * torch.exp(-0.5 * (0.4 * r).square() / g.covariances[0, 0, 0])
            errors[size] = float((((bell - alpha).square() * r).sum() / (alpha.square() * r).sum()).sqrt())
            areas[size] = float((bell * r).sum() / (alpha * r).sum())
        assert areas["profile"] == pytest.approx(1, abs=0.04)
        assert errors["profile"] < min(bound, errors["footprint"] - 0.005, errors["moments"] - 0.1), errors


def test_footprints_cover_what_thin_and_thick_primitives_cover(tmp_path: Path) -> None:
    """The area of alpha on the screen, seen from far away along an axis."""
    for i, thickness in enumerate((0.02, 6.0)):
        run = open_run(one_ellipsoid(tmp_path / str(i), thickness))
        g = fit_gaussians(run, {}, "footprint")
        areas = []
        R = quaternion_to_matrix(run.model.params["quats"].double())[0]
        s = [0.4, 0.2, 0.1]
        ratio = []
        for axis in range(3):
            u, v = (R[:, a] for a in range(3) if a != axis)
            flat = torch.stack([torch.stack([a @ g.covariances[0] @ b for b in (u, v)]) for a in (u, v)])
            bell = 2 * math.pi * float(g.opacities[0]) * math.sqrt(float(torch.linalg.det(flat)))
            a, b = (s[k] for k in range(3) if k != axis)
            r = np.linspace(0, 1, 4001)
            tau = thickness / 0.4 * 2 * s[axis] * np.sqrt(1 - r * r)
            ratio.append(np.trapezoid((1 - np.exp(-tau)) * 2 * math.pi * a * b * r, r) / bell)
            areas.append(bell)
        assert np.mean(ratio) == pytest.approx(1.0, abs=0.05), (thickness, ratio, areas)


def test_the_layout_and_every_convention(tmp_path: Path) -> None:
    run = marked.static_run(tmp_path / "run", marked.static_model(neurons=2, degree=2))
    report = export_run(run, "gaussian-ply", tmp_path / "g.ply", ["views=orbit"])
    found = read_ply(report.files[0])
    assert found.names == LAYOUT and len(LAYOUT) == 62 and not report.lossless
    assert all(found.rows.dtype[name] == "<f4" for name in LAYOUT)
    model = open_run(run).model
    assert np.allclose(
        found.columns(["x", "y", "z"]), marked.PLACES.numpy(), atol=0.01
    )  # the marked corner is the last
    assert np.allclose(found.columns(["f_dc_0", "f_dc_1", "f_dc_2"]), model.params["sh_dc"].numpy(), atol=1e-6)
    rest = model.params["sh_rest"].numpy()  # (N, 8, 3)
    for channel in range(3):
        names = [f"f_rest_{15 * channel + i}" for i in range(15)]
        assert (
            np.allclose(found.columns(names)[:, :8], rest[:, :, channel], atol=1e-6)
            and not found.columns(names)[:, 8:].any()
        )
    assert not found.columns(["nx", "ny", "nz"]).any()
    opacity = 1 / (1 + np.exp(-found.rows["opacity"]))
    assert (opacity > 0.95).all() and (opacity < 1).all()
    quats = found.columns([f"rot_{i}" for i in range(4)])
    assert np.allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
    sizes = np.exp(found.columns([f"scale_{i}" for i in range(3)]))
    assert (
        np.allclose(sizes, marked.RADII.numpy()[:, None] / math.sqrt(5), rtol=0.1)
        or "size=footprint" in report.notes[0]
    )
    assert 15 < report.errors["psnr_worst"] <= report.errors["psnr"] < 60


def test_what_it_wrote_starts_a_model_where_it_was(tmp_path: Path) -> None:
    run = marked.static_run(tmp_path / "run")
    path = export_run(run, "gaussian-ply", tmp_path / "g.ply", ["views=orbit", "size=moments"]).files[0]
    field = load_task("static").fields["SphericalHarmonics"](degree=1)  # type: ignore[index]
    settings = ModelSettings(primitives=9, init={"points": str(path)})
    fresh = initial_model_to_train(CosineDensity(3), field, tiny.two_primitives(), settings, 0)  # type: ignore[arg-type]
    assert torch.allclose(fresh.params["means"], marked.PLACES, atol=0.01)
    support, _ = CosineDensity(3).from_gaussians(
        torch.full((len(marked.RADII),), 0.99)
    )  # of bells; the file's are as wide as balls, seen from afar
    assert torch.allclose(fresh.params["log_scales"], (marked.RADII / math.sqrt(5) * support).log()[:, None], atol=0.1)
    assert torch.allclose(fresh.params["sh_dc"], open_run(run).model.params["sh_dc"], atol=1e-3)


def test_the_renderer_draws_one_gaussian_as_the_formula_says() -> None:
    eye = torch.tensor([0.0, -4.0, 0.0])
    view = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(view, 50.0, 50.0, 16.0, 16.0, 32, 32)
    covariance = torch.diag(torch.tensor([0.09, 0.01, 0.04], dtype=torch.float64))[None]
    g = Gaussians(torch.zeros(1, 3).double(), covariance, torch.tensor([0.6]).double(), torch.tensor([0]))
    colour = ExportHarmonics((torch.tensor([[1.0, 0.2, 0.0]]) - 0.5) / sh.C0, None, 0.0)
    image = draw_exported_gaussians(g, colour, camera, torch.zeros(3)).double()
    y, x = np.mgrid[:32, :32] + 0.5 - 16
    bell = 0.6 * np.exp(-0.5 * (x**2 / (0.09 * 12.5**2 + 0.3) + y**2 / (0.04 * 12.5**2 + 0.3)))
    bell[bell < 1 / 255] = 0
    assert np.allclose(image[..., 0].numpy(), bell, atol=1e-6) and np.allclose(
        image[..., 1].numpy(), 0.2 * bell, atol=1e-6
    )
    white = draw_exported_gaussians(g, colour, camera, torch.ones(3)).double()
    assert np.allclose(white[..., 2].numpy(), 1 - bell, atol=1e-6)


def test_nearer_gaussians_hide_farther_ones() -> None:
    view = look_at(torch.tensor([0.0, -4.0, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(view, 50.0, 50.0, 8.5, 8.5, 17, 17)
    means = torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, -5.0, 0.0]]).double()
    g = Gaussians(means, 0.01 * torch.eye(3).double().expand(3, 3, 3), torch.full((3,), 0.8).double(), torch.arange(3))
    colour = ExportHarmonics((torch.eye(3) - 0.5) / sh.C0, None, 0.0)
    middle = draw_exported_gaussians(g, colour, camera, torch.zeros(3))[8, 8]
    assert torch.allclose(middle, torch.tensor([0.8 * 0.2, 0.8, 0.0]), atol=1e-4)  # the third is behind the camera


def test_a_dynamic_model_needs_a_time_and_colours_follow_it(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    with pytest.raises(ConfigError, match=r"--time: required.*--time 0.5"):
        export_run(run, "gaussian-ply", tmp_path / "g.ply")
    with pytest.raises(ConfigError, match=r"g\.ply: several frames need several files; expected a folder"):
        export_run(run, "gaussian-ply", tmp_path / "g.ply", ["--time=0:1:3"])
    found = {}
    for t in (0.25, 0.5):
        report = export_run(run, "gaussian-ply", tmp_path / f"{t}.ply", [f"--time={t}"])
        found[t] = read_ply(report.files[0])
        assert any("linear" in note for note in report.notes) and report.errors["psnr"] > 15
        rows, back = (
            read_ply(report.files[0]),
            read_points(report.files[0], 3, "linear"),
        )  # its comment says that they are linear
        light = torch.from_numpy(rows.columns(["f_dc_0", "f_dc_1", "f_dc_2"]) * sh.C0 + 0.5).clamp_min(0).float()
        assert torch.allclose(back.colors, light, atol=1e-5)
    assert np.allclose(found[0.5].rows["f_dc_0"] - found[0.25].rows["f_dc_0"], 0.1 * 0.25, atol=1e-6)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_a_sequence_is_a_folder_of_numbered_files(tmp_path: Path, suffix: str) -> None:
    """Each file is that of its own time, and has the number of the source's frame."""
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    kind, options = f"gaussian-{suffix}", ["size=moments"]
    report = export_run(run, kind, None, ["--time=0,0.5,1", *options])
    numbers = ["0000", "0001", "0002"]  # this model's header names no frames
    assert list(report.files) == [run / "export" / "gaussians" / f"gaussians.{n}.{suffix}" for n in numbers]
    assert set(report.errors) == {f"frame_{n}.{key}" for n in numbers for key in ("psnr", "psnr_worst")}
    alone = export_run(run, kind, tmp_path / f"a.{suffix}", ["--time=0.5", *options]).files[0]
    assert report.files[1].read_bytes() == alone.read_bytes() != report.files[0].read_bytes()
    with pytest.raises(ConfigError, match=r"gaussians: exists and is not empty"):
        export_run(run, kind, None, ["--time=0,1", *options])


def test_colours_of_lobes_are_fitted_and_the_loss_is_stated(tmp_path: Path) -> None:
    model, generator = marked.static_model(), torch.Generator().manual_seed(2)
    task = load_task("static")
    assert task.fields is not None
    params = {name: value for name, value in model.params.items() if name != "sh_rest"}
    params |= {
        "lobe_amplitude": 0.2 * torch.rand(5, 2, 3, generator=generator),
        "lobe_axis": torch.randn(5, 2, 3, generator=generator),
        "lobe_log_sharpness": torch.full((5, 2), 1.0),
    }
    run = marked.static_run(
        tmp_path / "run",
        Primitives(model.density, task.fields["SphericalLobes"](lobes=2), params),  # type: ignore[call-arg, arg-type]
    )
    report = export_run(run, "gaussian-ply", tmp_path / "g.ply", ["views=orbit"])
    assert any("no harmonics of the view; fitted" in note for note in report.notes) and report.errors["psnr"] > 15
    assert 0 < fit_export_harmonics(open_run(run), {}).residual < 0.02


def test_a_relit_model_takes_a_light_and_fits_its_colours(tmp_path: Path) -> None:
    task = load_task("relight")
    assert task.fields is not None
    from neuprim.core.model.schema import InitContext

    colour = task.fields["LightNetwork"](hidden=4, visibility="none")
    context = InitContext(marked.PLACES, marked.RADII, marked.COLOURS, torch.Generator().manual_seed(1))
    model = Primitives.initialise(CosineDensity(2), colour, context)  # type: ignore[arg-type]
    model.params["net_out"] *= 2
    run = marked.write_run(tmp_path / "run", model, ["task=relight", "scene=lit_solids"])
    with pytest.raises(ConfigError, match="--light: required"):
        export_run(run, "gaussian-ply", tmp_path / "g.ply")
    report = export_run(run, "gaussian-ply", tmp_path / "g.ply", ["--light=1,2,3", "--light-intensity=1,1,1"])
    assert any("no harmonics" in note for note in report.notes) and report.errors["psnr"] > 20
    light = {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.ones(3)}
    fitted = fit_export_harmonics(open_run(run), light)
    assert 0 < fitted.residual < 0.05
    eye = torch.tensor([0.0, 0.0, 500.0])
    camera = Camera(look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), 50.0, 50.0, 8, 8, 16, 16)
    exact = model.lower(camera, light).colour
    expected = exact.primitive_radiance(torch.arange(5), torch.zeros(5, 3).double())  # type: ignore[union-attr]
    seen = fitted.evaluate(torch.arange(5), torch.tensor([[0.0, 0.0, -1.0]]).expand(5, 3))
    assert torch.allclose(seen, expected, atol=0.05)
