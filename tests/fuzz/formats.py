"""Every format that neuprim reads: a small valid example of it, how it is read, and how its structure is spoiled."""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.core.task import SceneContext
from tests.fuzz import mutations as m
from tests.fuzz.mutations import Mutation

Files = Mapping[str, Mutation]


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes:
        make: writes a valid example into an empty folder.
        read: reads the folder's files, and uses what it reads.
        files: those that are spoiled, with the mutations of their structure.
        slow: whether one reading takes a tenth of a second or more.
    """

    make: Callable[[Path], Any]
    read: Callable[[Path], Any]
    files: Files
    slow: bool = False


# ---------------------------------------------------------------- scenes


def _reader(module: str, function: str, *arguments: Any) -> Callable[[Path], None]:
    """Read ``a.*`` by a function of a module that is imported when it is needed."""
    return lambda folder: [
        getattr(import_module(module), function)(path, *arguments) for path in sorted(folder.glob("a.*"))
    ]


def _loader(module: str, function: str) -> Callable[[Path], None]:
    """Load the folder as a scene, and look at every view."""

    def read(folder: Path) -> None:
        load = getattr(import_module(module), function)
        dataset = load({"path": str(folder)}, SceneContext(seed=0, cache_dir=folder / "cache"))
        for views in (dataset.train, dataset.test):
            for i in range(len(views)):
                views.view(i), views.pixels(i)

    return read


def _posed(
    folder: Path, split: str, count: int, suffix: str = ".png", head: Mapping[str, Any] = {}, **more: Any
) -> None:
    """A transforms file of so many views of a square, with their images; ``more`` goes into every frame."""
    from tests.tasks.conftest import Scenes

    (folder / "images").mkdir(exist_ok=True)
    pixels = np.zeros((12, 16, 4), np.uint8)
    pixels[3:9, 4:12] = (200, 100, 50, 255)
    frames = []
    for i, pose in enumerate(Scenes.ring(count)):
        Image.fromarray(pixels).save(folder / f"images/{split}{i}.png")
        frames.append({"file_path": f"./images/{split}{i}{suffix}", "transform_matrix": pose.tolist(), **more})
    name = f"transforms_{split}.json" if split else "transforms.json"
    (folder / name).write_text(json.dumps({**(head or {"camera_angle_x": 0.9}), "frames": frames}))


def _blender(folder: Path) -> None:
    _posed(folder, "train", 3, "")
    _posed(folder, "test", 1, "")


def _nerfstudio(folder: Path) -> None:
    lens = {"w": 16, "h": 12, "fl_x": 15.0, "fl_y": 16.0, "cx": 8.0, "cy": 6.0, "camera_model": "OPENCV", "k1": 0.01}
    lens |= {"k2": 0.0, "p1": 0.0, "p2": 0.0, "ply_file_path": "points.ply"}
    _posed(folder, "", 9, head=lens, mask_path="mask.png")
    Image.fromarray(np.full((12, 16), 255, np.uint8)).save(folder / "mask.png")
    _points(folder)


def _multiview(folder: Path) -> None:
    _posed(folder, "train", 4, "", time=0.5)
    _posed(folder, "test", 1, "", time=0.25, rotation=0.1)


def _olat(folder: Path) -> None:
    _posed(folder, "train", 3, "", pl_pos=[1.0, 2.0, 4.0], pl_intensity=[1.0, 1.0, 1.0])
    _posed(folder, "test", 1, "", pl_pos=[1.0, 2.0, 4.0])


def _colmap(text: bool) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        import pycolmap

        from tests.tasks.conftest import Scenes

        model, params = pycolmap.Reconstruction(), [15, 16, 8, 6, 0.1, 0, 0, 0]
        lens = pycolmap.Camera(model="OPENCV", width=16, height=12, params=params, camera_id=1)
        model.add_camera_with_trivial_rig(lens)
        for i, pose in enumerate(Scenes.ring(9)):
            view = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
            rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3])
            model.add_image_with_trivial_frame(pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=9 - i), rigid)
            (folder / "images").mkdir(exist_ok=True)
            Image.fromarray(np.full((12, 16, 3), 20 * i, np.uint8)).save(folder / f"images/{i}.png")
        for point in np.eye(3):
            model.add_point3D(point, pycolmap.Track(), np.array([9, 99, 200], np.uint8))
        (folder / "sparse/0").mkdir(parents=True)
        (model.write_text if text else model.write_binary)(str(folder / "sparse/0"))

    return make


_PARTS = ("cameras", "images", "points3D", "rigs", "frames")


# ---------------------------------------------------------------- points, models of other programs


def _ply(path: Path, names: str, rows: np.ndarray, text: bool = False) -> None:
    head = f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property float {name}\n" for name in names.split()) + "end_header\n"
    body = (
        "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode() if text else rows.astype("<f4").tobytes()
    )
    path.write_bytes(head.encode() + body)


def _points(folder: Path) -> None:
    _ply(folder / "points.ply", "x y z red green blue", np.eye(6) + 0.5)
    _ply(folder / "text.ply", "x y z red green blue", np.eye(6) + 0.5, text=True)


def _gaussians(folder: Path) -> None:
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    _ply(folder / "points.ply", names, np.random.default_rng(0).normal(size=(5, 14)))


def _spz(version: int) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        from neuprim.core.io.spz import SpzGaussians, encode_spz

        some = np.random.default_rng(0).normal(size=(5, 16, 3))
        data = encode_spz(SpzGaussians(some[:, 0], some[:, 1], some[:, :2].reshape(5, 6)[:, :4], some[:, 2, 0], some))
        if version < 4:
            head = struct.pack("<IIIBBBB", 0x5053474E, version, 5, 3, 12, 0, 0)
            data = gzip.compress(head + some.tobytes()[: 5 * (9 + 1 + 3 + 3 + (3 if version < 3 else 4) + 45)])
        (folder / "a.spz").write_bytes(data)

    return make


def _read_points(folder: Path) -> None:
    from neuprim.core.data.points_file import read_points

    for name in ("points.ply", "text.ply"):
        if (folder / name).exists():
            read_points(folder / name, 3, "srgb")


_EXPORTED: dict[str, tuple[str, dict[str, Any]]] = {
    "text.ply": ("ply", {"encoding": "ascii"}),
    "a.stl": ("stl", {}),
    "text.stl": ("stl_ascii", {}),
}


def _mesh(name: str) -> tuple[Callable[[Path], Any], Callable[[Path], None]]:
    def make(folder: Path) -> None:
        import trimesh

        from tests import models

        path = folder / name
        vertices, faces, _ = models.cube()
        if name == "a.ply":
            models.write_ply(path, vertices, faces, np.full((24, 3), 99, np.uint8))
        elif path.suffix in (".ply", ".stl"):
            kind, options = _EXPORTED[name]
            data = trimesh.Trimesh(vertices, faces, process=False).export(file_type=kind, **options)
            path.write_bytes(data.encode() if isinstance(data, str) else data)
        else:
            {".glb": models.write_glb, ".gltf": models.write_gltf, ".obj": models.write_obj}[path.suffix](path)

    def read(folder: Path) -> None:
        from neuprim.tasks.static.mesh import MeshSettings, generate_mesh_images

        settings = MeshSettings(path=folder / name, size=8, train_views=1, test_views=1, supersampling=1)
        generate_mesh_images(settings, folder / "cache")

    return make, read


# ---------------------------------------------------------------- images and volumes


def _images(*suffixes: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        pixels = np.arange(12 * 16 * 4).reshape(12, 16, 4).astype(np.uint8)
        for suffix in suffixes:
            image = Image.fromarray(pixels if suffix in ("png", "webp") else pixels[..., :3])
            image.save(folder / f"a.{suffix}")

    return make


def _mask(folder: Path) -> None:
    Image.fromarray(np.arange(12 * 16).reshape(12, 16).astype(np.uint8)).save(folder / "a.png")


def _exr(folder: Path) -> None:
    from neuprim.core.io.exr import write_exr

    write_exr(folder / "a.exr", torch.rand(6, 12, 4))


def _read_images(folder: Path) -> None:
    from neuprim.core.io.images import image_info, read_image

    for path in sorted(folder.glob("a.*")):
        image_info(path)
        read_image(path)


def _vdb(folder: Path) -> None:
    from neuprim.core.io.vdb import VdbGrid, write_vdb

    values = np.random.default_rng(0).random((12, 10, 9)).astype(np.float32)
    for compression in ("none", "zip", "blosc"):
        grids = [VdbGrid.from_dense("density", values), VdbGrid.from_dense("heat", values[:3])]
        write_vdb(folder / f"{compression}.vdb", grids, compression=compression)


def _read_vdb(folder: Path) -> None:
    from tests.core.io.vdb.vdb_bytes import read_all

    for path in sorted(folder.glob("*.vdb")):
        read_all(path)


def _voxels(folder: Path) -> None:
    from neuprim.tasks.dynamic.volume.capture_voxels import MediumVoxels

    MediumVoxels(np.array([1, 5]), np.ones((2, 4), np.float32), (2, 3, 4), np.eye(4)).write(folder / "a.npz")


def _read_voxels(folder: Path) -> None:
    from neuprim.tasks.dynamic.volume.capture_voxels import MediumVoxels

    MediumVoxels.read(folder / "a.npz").find_cells(np.zeros((1, 3), np.int64))


# ---------------------------------------------------------------- cameras


def _cameras(folder: Path) -> None:
    pose = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
    frames = [
        {"transform_matrix": pose},
        {"transform_matrix": pose, "fl_x": 10, "fl_y": 11.5, "cx": 3, "cy": 7, "w": 20, "h": 30, "time": 0.5},
    ]
    (folder / "c.json").write_text(
        json.dumps({"w": 64, "h": 48, "camera_angle_x": math.pi / 2, "fps": 24, "frames": frames})
    )


_STAGE = """#usda 1.0
(
    upAxis = "Z"
    startTimeCode = 1
    endTimeCode = 3
)

def Xform "World"
{
    def Camera "Cam"
    {
        float focalLength.timeSamples = { 1: 35, 3: 45 }
        float horizontalAperture = 36
        float verticalAperture = 27
        matrix4d xformOp:transform.timeSamples = {
            1: ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, -4, 0, 1) ),
            3: ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (2, -4, 0, 1) )
        }
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }
}
"""


def _usd(folder: Path) -> None:
    (folder / "c.usda").write_text(_STAGE)


def _usdc(folder: Path) -> None:
    from pxr import Sdf

    _usd(folder)
    Sdf.Layer.FindOrOpen(str(folder / "c.usda")).Export(str(folder / "c.usdc"))


def _read_cameras(name: str) -> Callable[[Path], Any]:
    from neuprim.core.cameras.camera_files import read_camera_file

    return lambda folder: read_camera_file(folder / name, (32, 24))


# ---------------------------------------------------------------- runs


def _run(folder: Path) -> None:
    from tests.plugins import marked

    marked.static_run(folder / "run")


def _compressed(folder: Path) -> None:
    from neuprim.core import checkpoint
    from neuprim.core.compression.quantizers import LEVELS
    from tests.compressing import example, without_pieces

    for name, model in (("whole", example("static", 20)[1]), ("pruned", without_pieces(example("static", 20)[1]))):
        checkpoint.save_compressed(
            folder / f"{name}.neuprim", model, "static", {"note": "naïve"}, LEVELS[3], "task: static\n"
        )


def _read_compressed(folder: Path) -> None:
    from neuprim.core import checkpoint
    from neuprim.tasks.static import TASK

    for path in sorted(folder.glob("*.neuprim")):
        checkpoint.load_model_checkpoint(path, TASK)


def _read_run(folder: Path) -> None:
    from neuprim.report.run_record import read_reported_run
    from neuprim.runs.open import open_run, read_metrics

    run, record = open_run(folder / "run"), read_reported_run(folder / "run")
    repr((run.settings, run.header.get("background"), record.shown, record.view_numbers))
    if (folder / "run/metrics.json").exists():
        read_metrics(folder / "run")


def _records(folder: Path) -> None:
    """What runs, sweeps, chunks, searches and launches keep."""
    from neuprim.runs.launch.jobs import JobStatus, write_status
    from neuprim.runs.sweep import LaunchedRun, LaunchRecord
    from neuprim.search.target_record import SettingChange, TargetRecord
    from neuprim.search.tradeoff_record import LeftOutPoint, TradeoffPoint, TradeoffRecord
    from neuprim.search.trials import Outcome
    from tests.search.simulated_search import attempt

    _run(folder)
    view = {"name": "a", "psnr": 20.0, "ssim": 0.9}
    numbers = {"psnr": 20.0, "ssim": 0.9, "views": 1, "per_view": [view], "lpips": None, "train_seconds": 1.5}
    (folder / "run/metrics.json").write_text(json.dumps(numbers))
    lines = [{"step": i, "loss": 0.1, "primitives": 40, "seconds": 1.0 * i, "eval_psnr": 20.0} for i in (1, 2, 3)]
    (folder / "run/metrics.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    runs = (LaunchedRun("0", ("a=1",), {"a": "1"}), LaunchedRun("1", ("a=2",), {"a": "2"}, "failed", "why", 2.5, 1))
    LaunchRecord(folder / "sweep.json", ("a=1,2",), runs).write()
    LaunchRecord(folder / "chunks.json", (), runs, 100).write()
    turned = [SettingChange("model.neurons", 4, 2, {"psnr": 0.1}, 0.8, True)]
    TargetRecord({"psnr": 30.0}, {}, length=200, attempts=[attempt(100, 50, 30.0)], turns=turned).write(
        folder / "target"
    )
    points = [
        TradeoffPoint("reference", (), {"psnr": 30.0}, 100, [1.0, 1.1, 1.2], [1.0] * 3),
        TradeoffPoint("sort", ("renderer.sort=entry",), {"psnr": 29.0}, 100, [0.5], [0.5]),
    ]
    (folder / "run/tradeoff").mkdir()
    TradeoffRecord({"views": 1}, {}, points, [LeftOutPoint("a", ("b=1",), "why")], [0, 1], [0]).write(
        folder / "run/tradeoff/tradeoff.json"
    )
    outcome = Outcome(30.0, 0.9, 40, 12, 1000, 50, 1.5, 0.03, 10.0)
    (folder / "trial.json").write_text(json.dumps({"format": 1, "asked": {}, "views": 3, "outcome": asdict(outcome)}))
    write_status(folder / "status.json", JobStatus())


def _read_records(folder: Path) -> None:
    from neuprim.runs.launch.jobs import read_status
    from neuprim.runs.sweep import read_launch_record, read_sweep_runs, write_sweep_csv
    from neuprim.search import trials
    from neuprim.search.target_record import read_target_record as read_target
    from neuprim.search.tradeoff_record import read_tradeoff_record

    _read_run(folder)
    if (sweep := read_launch_record(folder / "sweep.json")) is not None:
        write_sweep_csv(folder / "out.csv", read_sweep_runs(sweep))
        replace(sweep, file=folder / "again/sweep.json").write()
    if (chunks := read_launch_record(folder / "chunks.json")) is not None:
        replace(chunks, file=folder / "again/chunks.json").write()
    if (target := read_target(folder / "target")) is not None:
        target.write(folder / "again")
        repr((target.words, target.finished("size"), [one.count for one in target.attempts if one.outcome]))
    if (points := read_tradeoff_record(folder / "run/tradeoff/tradeoff.json")) is not None:
        points.write(folder / "again/tradeoff.json")
    trials.read_trial(folder)
    read_status(folder / "status.json")


def _lpips(folder: Path) -> None:
    from safetensors.torch import save_file

    from tests.lpips_weights import weights

    small = {key: value[:1].contiguous() for key, value in weights("alex").items()}
    torch.save(small, folder / "weights.pth")
    save_file(small, folder / "weights.safetensors")


def _read_lpips(folder: Path) -> None:
    from neuprim.core.metrics.lpips import Lpips

    for name in ("weights.pth", "weights.safetensors"):
        try:
            Lpips.load(folder / name)
        except DataError as error:
            if not any(word in str(error) for word in ("shape", "missing", "convolutions")):
                raise


@cache
def _fitted(folder: Path) -> Any:
    """A training that goes on from the checkpoint in ``folder/out``."""
    from neuprim.config import compose
    from neuprim.runs.fit import prepare_training
    from tests.core import tiny
    from tests.short_runs import words

    return prepare_training(compose(words(tiny.write_blender(folder / "two"), folder / "out", 5, "resume=true")))


def _checkpoint(folder: Path) -> None:
    from neuprim.runs.training import save_run_training

    (folder / "out").mkdir()
    save_run_training(_fitted(folder))


def _read_checkpoint(folder: Path) -> None:
    from neuprim.runs.fit import ignore_run_event
    from neuprim.runs.training import _resume_training

    _resume_training(_fitted(folder), ignore_run_event)


_DATASETS, _IMAGES = "neuprim.tasks.static.datasets", "neuprim.core.io.images"
_POINTS = "neuprim.core.data.points_file"


_RECORDS: Files = {
    "run/metrics.jsonl": m.jsonl_of,
    **dict.fromkeys(("run/metrics.json", "run/tradeoff/tradeoff.json"), m.json_of),
    **dict.fromkeys(("sweep.json", "chunks.json", "target/target.json", "trial.json", "status.json"), m.json_of),
}
_SPLITS: Files = {"transforms_train.json": m.json_of, "transforms_test.json": m.json_of}

FORMATS: dict[str, Format] = {
    "blender": Format(_blender, _loader(_DATASETS, "load_blender"), _SPLITS),
    "nerfstudio": Format(
        _nerfstudio,
        _loader(_DATASETS, "load_nerfstudio"),
        {"transforms.json": m.json_of, "points.ply": m.text_of, "mask.png": m.png},
    ),
    "multiview": Format(
        _multiview, _loader("neuprim.tasks.dynamic.multiview", "load_moving_multiview"), _SPLITS, slow=True
    ),
    "olat": Format(_olat, _loader("neuprim.tasks.relight.datasets", "load_olat"), _SPLITS),
    "colmap": Format(
        _colmap(False), _loader(_DATASETS, "load_colmap"), {f"sparse/0/{part}.bin": m.lies(0, 400) for part in _PARTS}
    ),
    "colmap-text": Format(
        _colmap(True), _loader(_DATASETS, "load_colmap"), {f"sparse/0/{part}.txt": m.text_of for part in _PARTS}
    ),
    "points": Format(_points, _read_points, {"points.ply": m.text_of, "text.ply": m.text_of}),
    "gaussians": Format(_gaussians, _read_points, {"points.ply": m.text_of}),
    "spz": Format(_spz(4), _reader(_POINTS, "read_points", 3, "srgb"), {"a.spz": m.lies(0, 130)}),
    "spz-gzip": Format(_spz(2), _reader(_POINTS, "read_points", 3, "srgb"), {"a.spz": m.gzipped}),
    "mesh-ply": Format(*_mesh("a.ply"), {"a.ply": m.text_of}),
    "mesh-stl": Format(*_mesh("a.stl"), {"a.stl": m.lies(0, 300)}),
    "mesh-text-ply": Format(*_mesh("text.ply"), {"text.ply": m.text_of}),
    "mesh-text-stl": Format(*_mesh("text.stl"), {"text.stl": m.text_of}),
    "mesh-obj": Format(*_mesh("a.obj"), {"a.obj": m.text_of, "a.mtl": m.text_of, "skin.png": m.png}),
    "gltf": Format(*_mesh("a.gltf"), {"a.gltf": m.json_of, "triangle.bin": m.lies(0, 44)}),
    "glb": Format(*_mesh("a.glb"), {"a.glb": m.glb}),
    "png": Format(_images("png"), _read_images, {"a.png": m.png}),
    "jpeg": Format(_images("jpg"), _read_images, {"a.jpg": m.lies(0, 400)}),
    "webp": Format(_images("webp"), _read_images, {"a.webp": m.lies(0, 100)}),
    "mask": Format(_mask, _reader(_IMAGES, "read_mask_image"), {"a.png": m.png}),
    "exr": Format(_exr, _read_images, {"a.exr": m.lies(0, 420)}),
    "environment": Format(_exr, _reader("neuprim.core.environment", "read_environment"), {"a.exr": m.lies(0, 420)}),
    "vdb": Format(_vdb, _read_vdb, {f"{name}.vdb": m.lies(0, 1500) for name in ("none", "zip", "blosc")}),
    "voxels": Format(_voxels, _read_voxels, {"a.npz": m.npz}),
    "cameras": Format(_cameras, _read_cameras("c.json"), {"c.json": m.json_of}),
    "cameras-usd": Format(_usd, _read_cameras("c.usda"), {"c.usda": m.text_of}, slow=True),
    "cameras-usdc": Format(_usdc, _read_cameras("c.usdc"), {"c.usdc": m.lies(0, 400)}, slow=True),
    "config": Format(_run, _read_run, {"run/config.yaml": m.yaml_of}),
    "model": Format(_run, _read_run, {"run/model.safetensors": m.safetensors}),
    "checkpoint": Format(_checkpoint, _read_checkpoint, {"out/checkpoint.safetensors": m.safetensors}),
    "lpips": Format(_lpips, _read_lpips, {"weights.pth": m.npz, "weights.safetensors": m.safetensors}),
    "records": Format(_records, _read_records, _RECORDS),
    "compressed": Format(
        _compressed, _read_compressed, {"whole.neuprim": m.compressed, "pruned.neuprim": m.compressed}
    ),
}
