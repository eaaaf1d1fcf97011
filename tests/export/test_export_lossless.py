"""`neuprim export --format ply|npz` and `neuprim import`: the model leaves and comes back bit for bit, and damage is
refused."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch

from neuprim.cli import main
from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.core.io.ply import read_ply, write_ply
from neuprim.runs.export import export_run, import_run_directory
from neuprim.runs.open import load_run
from neuprim.runs.render_images import RenderRequest, render_run
from tests.plugins import marked

LOSSLESS = ("ply", "npz")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked.static_run(tmp_path_factory.mktemp("runs") / "marked run")


@pytest.mark.parametrize("form", LOSSLESS)
@pytest.mark.parametrize(("neurons", "degree"), [(3, 1), (0, 0)])
def test_a_run_comes_back_bit_for_bit(tmp_path: Path, form: str, neurons: int, degree: int) -> None:
    model = marked.static_model(neurons, degree)
    model.params["means"][0] = torch.tensor([-0.0, 1e-42, 3.4e38])
    run = marked.static_run(tmp_path / "run", model)
    report = export_run(run, form)
    assert report.lossless and report.files == (run / "export" / f"model.{form}",)
    back = import_run_directory(report.files[0], tmp_path / "back")
    for name in ("model.safetensors", "config.yaml"):
        assert (back / name).read_bytes() == (run / name).read_bytes()


def test_what_was_imported_renders_without_the_data(run_dir: Path, tmp_path: Path) -> None:
    back = import_run_directory(export_run(run_dir, "ply", tmp_path / "m.ply").files[0], tmp_path / "back")
    pose = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
    (tmp_path / "c.json").write_text(
        json.dumps({"camera_angle_x": 0.9, "w": 20, "h": 16, "frames": [{"transform_matrix": pose}]})
    )
    pictures = [
        render_run(d, RenderRequest(str(tmp_path / "c.json"), format="exr", out=tmp_path / f"{i}.exr", frames=1))[0]
        for i, d in enumerate((run_dir, back))
    ]
    first, second = (
        {name: channel.pixels for name, channel in OpenEXR.File(str(path)).parts[0].channels.items()}
        for path in pictures
    )
    assert first.keys() == second.keys() >= {"RGBA", "depth.Z"}  # headers differ: they name the run
    assert all((first[name] == second[name]).all() for name in first)


def test_the_ply_names_every_number(run_dir: Path, tmp_path: Path) -> None:
    found = read_ply(export_run(run_dir, "ply", tmp_path / "m.ply").files[0])
    stored = load_run(run_dir)
    model, header = stored.model, stored.header
    corner = found.rows[4]  # the marked corner
    assert [float(corner[n]) for n in ("x", "y", "z")] == pytest.approx([0.5, 0.7, 0.9])
    assert [float(corner[f"means_{i}"]) for i in range(3)] == pytest.approx([0.5, 0.7, 0.9])
    assert float(corner["W1_5"]) == float(model.params["W1"][4, 1, 2])
    record = json.loads(found.comments[0].removeprefix("neuprim "))
    assert record["model"]["task"] == "static" and record["model"]["background"] == header["background"]
    assert record["parameters"]["W1"] == [3, 3] and "renderer:" in record["config"]


def test_numpy_reads_the_npz_without_pickle(run_dir: Path, tmp_path: Path) -> None:
    with np.load(export_run(run_dir, "npz", tmp_path / "m.npz").files[0], allow_pickle=False) as file:
        assert file["means"].dtype == np.float32 and np.allclose(file["means"][4], [0.5, 0.7, 0.9])
        assert json.loads(str(file["header"]))["model"]["color_space"] == "srgb"


# ---------------------------------------------------------------- the command


def test_the_command_prints_files_and_json_and_replaces_nothing(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "m.ply"
    assert main(["export", str(run_dir), "--format", "ply", "--out", str(out), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["files"] == [str(out)] and record["lossless"] is True and record["errors"] == {}
    before = out.stat().st_mtime_ns
    assert main(["export", str(run_dir), "--format", "ply", "--out", str(out)]) == 2
    assert "--force" in capsys.readouterr().err and out.stat().st_mtime_ns == before
    assert main(["export", str(run_dir), "--format", "ply", "--out", str(out), "--force"]) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [str(out), "lossless"]
    assert main(["import", str(out), "--out", str(tmp_path / "back")]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "back")
    assert main(["import", str(out), "--out", str(tmp_path / "back")]) == 2
    assert "not an empty folder" in capsys.readouterr().err


# ---------------------------------------------------------------- untrusted files


def test_other_plys_are_named_for_what_they_are(run_dir: Path, tmp_path: Path) -> None:
    write_ply(tmp_path / "g.ply", np.zeros(1, [("x", "<f4")]))
    with pytest.raises(DataError, match=r"model\.init\.points"):
        import_run_directory(tmp_path / "g.ply", tmp_path / "out")
    (tmp_path / "m.obj").write_text("x")
    with pytest.raises(ConfigError, match=r"cannot import \.obj files"):
        import_run_directory(tmp_path / "m.obj", tmp_path / "out")
    with pytest.raises(DataError, match="no such file"):
        import_run_directory(tmp_path / "none.ply", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def rewritten(run_dir: Path, path: Path, change: Any) -> Path:
    """The run's PLY with its header changed by ``change(record)``."""
    found = read_ply(export_run(run_dir, "ply", path).files[0])
    record = json.loads(found.comments[0].removeprefix("neuprim "))
    record = change(record) or record
    write_ply(path, found.rows, ["neuprim " + json.dumps(record)])
    return path


def put(*keys: str, value: Any) -> Any:
    def change(record: dict[str, Any]) -> None:
        node = record
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        put("format", value=2),
        put("model", value=None),
        put("config", value=["task: static"]),
        put("config", value="!!python/object/apply:os.system ['true']"),
        put("config", value="task: {name: static}"),
        put("model", "task", value="relight"),
        put("model", "task", value=["static"]),
        put("model", "density", value={"class": "CosineDensity", "settings": {"neurons": 10**9}}),
        put("model", "density", value={"class": "Popen", "settings": {}}),
        put("parameters", "W1", value=[10**6, 3]),
        put("parameters", "W1", value=[4, 3]),
        put("parameters", "W1", value=[3, 3.0]),
        put("parameters", "other", value=[]),
        put("parameters", value={}),
        lambda record: [record],
    ],
)
def test_a_changed_header_is_refused(run_dir: Path, tmp_path: Path, change: Any) -> None:
    path = rewritten(run_dir, tmp_path / "m.ply", change)
    with pytest.raises(NeuprimError) as caught:
        import_run_directory(path, tmp_path / "out")
    assert str(path) in str(caught.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.ply"]


def test_numbers_that_are_not_finite_are_refused(run_dir: Path, tmp_path: Path) -> None:
    found = read_ply(export_run(run_dir, "ply", tmp_path / "m.ply").files[0])
    found.rows["b2_0"][1] = np.nan
    write_ply(tmp_path / "m.ply", found.rows, found.comments)
    with pytest.raises(DataError, match="b2 has NaN"):
        import_run_directory(tmp_path / "m.ply", tmp_path / "out")


def test_npz_bombs_and_pickles_are_refused(run_dir: Path, tmp_path: Path) -> None:
    good = export_run(run_dir, "npz", tmp_path / "m.npz").files[0]
    with zipfile.ZipFile(good) as archive:
        entries = {i.filename: archive.read(i) for i in archive.infolist()}

    def packed(name: str, **changes: bytes | None) -> Path:
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for key, value in {**entries, **{f"{k}.npy": v for k, v in changes.items()}}.items():
                if value is not None:
                    archive.writestr(key, value)
        return tmp_path / name

    assert import_run_directory(packed("fine.npz"), tmp_path / "fine").is_dir()
    zeros = np.lib.format.magic(1, 0) + entries["means.npy"][8:10] + entries["means.npy"][10:]
    claims = zeros.replace(b"(5, 3)", b"(9000000000, 3)".ljust(6))
    objects = np.array([{}], object)
    import io

    pickled = io.BytesIO()
    np.save(pickled, objects, allow_pickle=True)
    for name, change in {
        "bomb": {"means": entries["means.npy"] + bytes(50_000_000)},
        "claim": {"means": claims},
        "pickle": {"means": pickled.getvalue()},
        "header_pickle": {"header": pickled.getvalue()},
        "missing": {"quats": None},
        "headless": {"header": None},
        "cut": {"means": entries["means.npy"][:-3]},
        "garbage": {"means": b"not numpy"},
    }.items():
        with pytest.raises(DataError, match=rf"{name}\.npz"):
            import_run_directory(packed(f"{name}.npz", **change), tmp_path / "out")
    (tmp_path / "text.npz").write_text("not a zip")
    with pytest.raises(DataError, match="not a readable"):
        import_run_directory(tmp_path / "text.npz", tmp_path / "out")
    assert not (tmp_path / "out").exists()
