"""The CUDA backend on a GPU: parity with the float64 reference, times, frames per second, peak memory.

    python benchmarks/gpu.py [--parts parity times steps frames kernels train runs]
        [--scenes 5000 20000 100000 300000 1000000] [--sizes 800x800 1920x1080]
        [--chair DIR] [--fire DIR] [--mic DIR] [--seconds 60 300] [--trained chair fire lit_solids] [--record]
    python benchmarks/gpu.py --print [--docs]

    parity    images and all gradients of small scenes (thin, deep, around the camera) for several forms against the
              reference, and reruns bit for bit; needs no GPU with --device cpu, on Warp's CPU blocks
    times     random scenes whose primitives shrink as they multiply, 8 neurons and the default form: ms for a forward
              pass without gradients, a forward and backward pass, and a whole training step (L1 loss, Adam on every
              parameter), medians by CUDA events; frames per second, peak memory, primitive-pixel hits
    steps     training steps of the trainer on random scenes, replayed as a CUDA graph and not: ms a step, and whether
              both end with the same bits
    frames    frames of these scenes, replayed as a CUDA graph and not: ms until the image is complete
    kernels   where a training step's time goes, kernel by kernel, of the scene with the most primitives up to 100,000
    train     preset quick of each task with its usual steps on the GPU: ms a step of the second half, PSNR on the test
              views
    runs      the static preset on NeRF-synthetic mic at 800x800 (--mic) for 60 and 300 seconds (--seconds)

--record writes benchmarks/results/gpu/DEVICE.json and the tables of docs/results/gpu.md, in which every recorded device
has its own; --print makes them from what is recorded. Times are absolute, of the device named there.
"""

from __future__ import annotations

import itertools
import re
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser, require_folders
from shared.forms import SCENES
from shared.parity import NAMES, measure_parity
from shared.scenes import lower, random_scene, view
from shared.tables import (
    RESULT_PAGES,
    RESULTS,
    Columns,
    Record,
    Run,
    between_markers,
    make_table,
    read_record,
    update_record,
)
from shared.trials import Trial, begin

from neuprim.config import compose
from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import orbit
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet
from neuprim.core.model.cosine import OMEGA0, CosineDensity
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render import RenderSettings, render, render_lowered
from neuprim.core.train.losses import photometric
from neuprim.core.train.settings import PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import prepare_training, train_to_end
from neuprim.tasks.static import SphericalHarmonics

FOLDER, PAGE = RESULTS / "gpu", RESULT_PAGES / "gpu.md"
FORMS = {"K=8 p=0": (8, 0), "K=2 p=2": (2, 2), "K=0 p=2": (0, 2)}
PARTS = ("parity", "times", "steps", "frames", "kernels", "train", "runs")
RUNS = {60: 38_000, 300: 38_000}
"""Seconds -> primitives."""
STEPS = {"chair": 2500, "fire": 4000, "smoke_fire": 4000, "lit_solids": 2600}
"""Those of the recorded rows of the other benchmarks."""


# ---------------------------------------------------------------- times


def median_ms(run: Callable[[], Any], repeats: int = 20, warm: int = 3) -> float:
    """Of CUDA events around each run."""
    for _ in range(warm):
        run()
    times = []
    for _ in range(repeats):
        start, stop = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        run()
        stop.record()
        stop.synchronize()
        times.append(start.elapsed_time(stop))
    return statistics.median(times)


def scene_on_gpu(count: int, neurons: int, edge: int) -> tuple[LoweredPrimitives, list[torch.Tensor]]:
    """The random scene of the other benchmarks, its first neurons, and the tensors that it is made of."""
    low = lower(random_scene(count))
    g, d, c = low.geometry, low.density, low.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    tensors = [g.means, g.log_scales, g.quats, d.W1[:, :neurons], d.b1[:, :neurons], d.w2[:, :neurons], d.b2, c.rgb]
    leaves = [tensor.detach().cuda().contiguous().requires_grad_() for tensor in tensors]
    means, log_scales, quats, W1, b1, w2, b2, rgb = leaves
    return LoweredPrimitives(
        Geometry(means, log_scales, quats), Cosine(W1, b1, w2, b2, 1.0, edge), Constant(rgb)
    ), leaves


def make_camera(width: int, height: int) -> Camera:
    square = view(height)
    return Camera(square.viewmat, square.fx, square.fy, width / 2, height / 2, width, height)


def make_passes(
    lowered: LoweredPrimitives, leaves: list[torch.Tensor], camera: Camera
) -> dict[str, Callable[[], None]]:
    """A forward pass, a forward and backward pass, and a training step."""
    settings, background = RenderSettings(backend="cuda"), torch.zeros(3, device="cuda")
    target = torch.rand(camera.height, camera.width, 3, device="cuda")
    used = [leaf for leaf in leaves if leaf.numel()]
    adam = torch.optim.Adam(used, lr=0.0, fused=True)

    def forward() -> None:
        with torch.no_grad():
            render_lowered(lowered, camera, settings, background)

    def both() -> None:
        torch.autograd.grad(render_lowered(lowered, camera, settings, background).rgb, used, target)

    def step() -> None:
        adam.zero_grad(set_to_none=True)
        loss = (render_lowered(lowered, camera, settings, background).rgb - target).abs().mean()
        loss.backward()
        adam.step()

    return {"forward_ms": forward, "both_ms": both, "step_ms": step}


def measure_times(counts: Sequence[int], sizes: Sequence[tuple[int, int]]) -> Iterator[Record]:
    for name, form in FORMS.items():
        for count in counts:
            lowered, leaves = scene_on_gpu(count, *form)
            for width, height in sizes:
                camera = make_camera(width, height)
                torch.cuda.reset_peak_memory_stats()
                passes = make_passes(lowered, leaves, camera)
                stats = render_lowered(lowered, camera, RenderSettings(backend="cuda")).stats
                yield {
                    "form": name,
                    "primitives": count,
                    "width": width,
                    "height": height,
                    "pairs": stats.pairs,
                    "slots": stats.extra["hits"],
                    "delicate": stats.extra["float64"],
                    **{key: median_ms(run) for key, run in passes.items()},
                    "peak_mb": torch.cuda.max_memory_allocated() / 1e6,
                }
            del lowered, leaves


class RandomViews(ViewSet):
    """Views of a random scene, with images of noise."""

    def __init__(self, camera: Camera, count: int = 4) -> None:
        self.cameras = orbit(camera, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), 1.7, 0.3, count)
        generator = torch.Generator().manual_seed(0)
        shape = (camera.height, camera.width)
        self.images = [Pixels(torch.rand(*shape, 3, generator=generator), torch.ones(shape)) for _ in range(count)]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(f"v{index}", self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def random_trainer(count: int, neurons: int, edge: int, camera: Camera, device: str = "cuda") -> Trainer:
    """A trainer of the random scene of the other benchmarks, with one colour per primitive."""
    low = lower(random_scene(count))
    g, d, c = low.geometry, low.density, low.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    scale = 1 / OMEGA0
    params = {"means": g.means, "log_scales": g.log_scales, "quats": g.quats, "W1": scale * d.W1[:, :neurons]}
    params |= {"b1": scale * d.b1[:, :neurons], "w2": d.w2[:, :neurons], "b2": d.b2.reshape(-1, 1), "sh_dc": c.rgb}
    params = {name: value.detach().clone().contiguous() for name, value in params.items()}
    model = Primitives(CosineDensity(neurons, edge=edge), SphericalHarmonics(0), params)
    views, black = RandomViews(camera), torch.zeros(3)
    start = PointCloud(params["means"], params["sh_dc"])
    data = Dataset(
        name="random", train=views, test=views, start=lambda *_: start, extent=1.0, background=black,
        data_source="generated",
    )  # fmt: skip
    population = PopulationSettings(strategy="fixed")
    train = TrainSettings(iterations=1_000_000, population=population)
    renderer = RenderSettings(backend="cuda", device=device, near=0.1)
    return Trainer(model, data, photometric({"ssim_weight": 0.2}), train, renderer, 0)


def measure_steps(counts: Sequence[int], sizes: Sequence[tuple[int, int]], steps: int = 100) -> Iterator[Record]:
    for name, form in FORMS.items():
        for count in counts:
            for width, height in sizes:
                row: Record = {"form": name, "primitives": count, "width": width, "height": height}
                states = []
                for key in ("each_ms", "graph_ms"):
                    trainer = random_trainer(count, *form, make_camera(width, height))
                    if key == "each_ms":
                        trainer.recorder = None
                    for _ in range(steps // 5):
                        trainer.train_step()
                    trainer.settle()
                    torch.cuda.synchronize()
                    start = time.perf_counter()
                    for _ in range(steps):
                        trainer.train_step()
                    trainer.settle()
                    torch.cuda.synchronize()
                    row[key] = 1e3 * (time.perf_counter() - start) / steps
                    states.append(trainer.state()[0])
                    row["replayed"] = 0 if trainer.recorder is None else trainer.recorder.replayed
                    del trainer
                yield {**row, "same": all(torch.equal(states[0][name], states[1][name]) for name in states[0])}


def measure_frames(counts: Sequence[int], sizes: Sequence[tuple[int, int]]) -> Iterator[Record]:
    """Frames of a model from places around it: until the image is complete, replayed and with every kernel launched."""
    for name, form in FORMS.items():
        for count in counts:
            for width, height in sizes:
                trainer = random_trainer(count, *form, make_camera(width, height))
                model, views = trainer.model, trainer.dataset.train
                cameras = itertools.cycle([views.view(i).camera for i in range(len(views))])

                def replayed(cameras: Any = cameras, model: Any = model, settings: Any = trainer.renderer) -> None:
                    with torch.no_grad():
                        render(model, next(cameras), {}, settings)

                def launched(cameras: Any = cameras, model: Any = model, settings: Any = trainer.renderer) -> None:
                    with torch.no_grad():
                        camera = next(cameras)
                        render_lowered(model.lower(camera, {}), camera, settings)

                row: Record = {"form": name, "primitives": count, "width": width, "height": height}
                yield {**row, "frame_ms": median_ms(replayed, warm=12), "launched_ms": median_ms(launched)}


def measure_kernels(count: int, width: int, height: int) -> dict[str, dict[str, float]]:
    """Milliseconds of each kernel in a training step, by form."""
    found = {}
    activities = [torch.profiler.ProfilerActivity.CUDA, torch.profiler.ProfilerActivity.CPU]
    for name, form in FORMS.items():
        step = random_trainer(count, *form, make_camera(width, height)).train_step
        for _ in range(12):  # the last ones are replayed
            step()
        with torch.profiler.profile(activities=activities) as profile:
            for _ in range(5):
                step()
            torch.cuda.synchronize()
        spent: dict[str, float] = {}
        for event in profile.events():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                label = re.sub(r"_[0-9a-f]{6,}.*", "", event.name)[:60]
                spent[label] = spent.get(label, 0.0) + event.device_time / 5e3
        found[name] = dict(sorted(spent.items(), key=lambda item: -item[1])[:24])
        print(f"{name}, {count} primitives, {width}x{height}: {sum(spent.values()):.2f} ms on the device in a step")
        for label, ms in list(found[name].items())[:16]:
            print(f"    {ms:7.3f}  {label}")
    return found


def measure_training(names: Sequence[str], folders: Mapping[str, Any]) -> Iterator[Record]:
    for name in names:
        scene, steps = SCENES[name], STEPS[name]
        fitted = begin(Trial(name, (*scene.all_words(folders, name), "renderer.device=cuda"), steps))
        while fitted.trainer.step < steps // 2:  # kernels are compiled and views read in this half
            fitted.trainer.train_step()
        before = fitted.trainer.elapsed
        fitted = train_to_end(fitted)
        ms = 1e3 * (fitted.trainer.elapsed - before) / (steps - steps // 2)
        yield {
            "scene": name,
            "primitives": fitted.model.count,
            "steps": steps,
            "step_ms": ms,
            "psnr": fitted.metrics()[scene.judged],
            "of": scene.judged,
        }


def measure_runs(folder: Path, budgets: Sequence[int]) -> Iterator[Record]:
    for seconds in budgets:
        count = RUNS[seconds]
        words = ["task=static", "scene=blender", f"scene.path='{folder}'", f"model.primitives={count}"]
        words += ["train.iterations=null", f"train.max_seconds={seconds}", "train.eval_every=0", "renderer.device=cuda"]
        fitted = train_to_end(prepare_training(compose(words, check_output=False)))
        metrics = fitted.metrics()
        keys = ("primitives", "model_bytes", "iterations", "psnr", "ssim_3dgs")
        yield {"scene": folder.name, "seconds": seconds, **{key: metrics[key] for key in keys}}


# ---------------------------------------------------------------- tables


def gradient_cell(name: str) -> Callable[[Run], str]:
    """Of no neurons there is no gradient."""
    return lambda row: f"{row['gradients'][name]:.0e}" if row["neurons"] or name not in ("W1", "b1", "w2") else "–"


COLUMNS: dict[str, Columns] = {
    "parity": {
        "K, p": lambda row: f"{row['neurons']}, {row['edge']}",
        "scene": lambda row: row["scene"],
        "image": lambda row: f"{row['image']:.0e}",
        **{name: gradient_cell(name) for name in NAMES},
        "same bits again": lambda row: "yes" if row["same"] else "**no**",
    },
    "times": {
        "form": lambda row: row["form"],
        "primitives": lambda row: f"{row['primitives']:,}",
        "size": lambda row: f"{row['width']}×{row['height']}",
        "pairs": lambda row: f"{row['pairs']:,}",
        "slots": lambda row: f"{row['slots']:,}",
        "forward, ms": lambda row: f"{row['forward_ms']:.2f}",
        "and backward": lambda row: f"{row['both_ms']:.2f}",
        "training step": lambda row: f"{row['step_ms']:.2f}",
        "frames/s": lambda row: f"{1000 / row['forward_ms']:.0f}",
        "peak MB": lambda row: f"{row['peak_mb']:,.0f}",
    },
    "steps": {
        "form": lambda row: row["form"],
        "loss": lambda row: row.get("loss", "L1 + SSIM"),
        "primitives": lambda row: f"{row['primitives']:,}",
        "size": lambda row: f"{row['width']}×{row['height']}",
        "launched, ms": lambda row: f"{row['each_ms']:.2f}",
        "graph, ms": lambda row: f"{row['graph_ms']:.2f}",
        "same bits": lambda row: "yes" if row["same"] else "**no**",
    },
    "frames": {
        "form": lambda row: row["form"],
        "primitives": lambda row: f"{row['primitives']:,}",
        "size": lambda row: f"{row['width']}×{row['height']}",
        "launched, ms": lambda row: f"{row['launched_ms']:.2f}",
        "graph, ms": lambda row: f"{row['frame_ms']:.2f}",
        "frames/s": lambda row: f"{1000 / row['frame_ms']:.0f}",
    },
    "train": {
        "scene": lambda row: row["scene"].replace("_", " "),
        "primitives": lambda row: f"{row['primitives']:,}",
        "steps": lambda row: f"{row['steps']:,}",
        "ms a step": lambda row: f"{row['step_ms']:.2f}",
        "PSNR, dB": lambda row: f"{row['psnr']:.2f} ({row['of']})",
    },
    "runs": {
        "scene": lambda row: row["scene"],
        "training": lambda row: f"{row['seconds']} s",
        "primitives": lambda row: f"{row['primitives']:,}",
        "bytes": lambda row: f"{row['model_bytes']:,}",
        "steps": lambda row: f"{row['iterations']:,}",
        "PSNR": lambda row: f"{row['psnr']:.2f}",
        "SSIM (3DGS)": lambda row: f"{row['ssim_3dgs']:.4f}",
    },
}


def read_records() -> list[Record]:
    """A record per device, GPUs first."""
    found = [read_record(path) for path in sorted(FOLDER.glob("*.json"))]
    return sorted(found, key=lambda record: "times" not in record)


def make_tables(records: Sequence[Record]) -> dict[str, str]:
    """The text of each pair of markers: a table per device that has the part, under its name."""

    def tables(part: str, columns: Columns) -> str:
        return "\n\n".join(
            f"{record['device']}, torch {record['torch']}:\n\n{make_table(columns, record[part])}"
            for record in records
            if part in record
        )

    texts = {part: tables(part, columns) for part, columns in COLUMNS.items()}
    markers = {
        "gpu-parity": "parity",
        "gpu-times": "times",
        "gpu-steps": "steps",
        "gpu-frames": "frames",
        "gpu-training": "train",
        "gpu-runs": "runs",
    }
    return {marker: texts[part] for marker, part in markers.items()}


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--record", "--docs", "--print")
    parser.add_argument("--parts", nargs="*", default=PARTS, choices=PARTS)
    parser.add_argument("--scenes", nargs="*", type=int, default=[5_000, 20_000, 100_000, 300_000, 1_000_000])
    parser.add_argument("--sizes", nargs="*", default=["800x800", "1920x1080"])
    parser.add_argument("--mic", type=Path, help="NeRF-synthetic mic at 800x800")
    parser.add_argument("--seconds", nargs="*", type=int, default=list(RUNS), choices=list(RUNS), help="of runs")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"), help="of the part parity")
    parser.add_argument("--trained", nargs="*", default=["chair", "fire", "lit_solids"], choices=list(STEPS))
    args = parser.parse_args()
    if not args.only_print:
        sizes = [(int(width), int(height)) for width, height in (size.split("x") for size in args.sizes)]
        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "Warp's CPU blocks"
        result: Record = {"device": device, "torch": torch.__version__}
        measures: dict[str, Callable[[], Any]] = {
            "parity": lambda: list(measure_parity(args.device)),
            "times": lambda: list(measure_times(args.scenes, sizes)),
            "steps": lambda: list(measure_steps(args.scenes, sizes)),
            "frames": lambda: list(measure_frames(args.scenes, sizes)),
            "kernels": lambda: measure_kernels(max((c for c in args.scenes if c <= 100_000), default=5000), *sizes[0]),
            "train": lambda: list(measure_training(args.trained, vars(args))),
            "runs": lambda: list(measure_runs(args.mic, args.seconds)),
        }
        if "runs" in args.parts and args.mic is None:
            parser.error("the part runs wants --mic DIR")
        if "train" in args.parts:
            require_folders(parser, args, args.trained)
        name = re.sub(r"[^a-z0-9]+", "_", device.lower()).strip("_")
        for part in args.parts:
            result[part] = measures[part]()
            if part in COLUMNS:
                make_table(COLUMNS[part], result[part])
            if args.record:  # after each part, as a later one may fail
                update_record(Path(FOLDER / f"{name}.json"), **result)
    if args.only_print or args.record:
        for marker, text in make_tables(read_records()).items():
            if args.docs or args.record:
                between_markers(PAGE, marker, text)


if __name__ == "__main__":
    main()
