"""The CUDA backend on a card: parity with the float64 reference, times, frames per second, peak memory.

    python benchmarks/gpu.py [--parts parity times kernels train] [--scenes 5000 20000 100000 300000 1000000]
    [--sizes 800x800 1920x1080]
        [--chair DIR] [--fire DIR] [--trained chair fire lit_solids] [--record]

    parity    images and all gradients of small scenes (thin, deep, around the camera) for several forms against the
    reference, and reruns bit
              for bit; needs no card with --device cpu, on Warp's CPU blocks
    times     random scenes whose primitives shrink as they multiply, 8 neurons and the default form: ms for a forward
    pass without gradients, a
              forward and backward pass, and a whole training step (L1 loss, Adam on every parameter), medians by CUDA
              events; frames per second, peak memory, primitive-pixel hits
    kernels   where a training step's time goes, kernel by kernel, of the scene with the most primitives up to 100,000
    train     preset quick of each task with its usual steps on the card: ms a step of the second half, PSNR on the test
    views

--record writes benchmarks/results/gpu/DEVICE.json. Times are absolute, of the device named there.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from shared.parity import parity
from shared.scenes import lower, random_scene, view
from shared.tables import Table

from neuprim.core.cameras import Camera
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered

RESULTS = Path(__file__).parent / "results" / "gpu"
FORMS = {"K=8 p=0": (8, 0), "K=2 p=2": (2, 2), "K=0 p=2": (0, 2)}


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


def scene_on(count: int, neurons: int, edge: int) -> tuple[Lowered, list[torch.Tensor]]:
    """The random scene of the other benchmarks, its first neurons, on the card."""
    low = lower(random_scene(count))
    g, d, c = low.geometry, low.density, low.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    tensors = [g.means, g.log_scales, g.quats, d.W1[:, :neurons], d.b1[:, :neurons], d.w2[:, :neurons], d.b2, c.rgb]
    means, log_scales, quats, W1, b1, w2, b2, rgb = leaves = [
        t.detach().cuda().contiguous().requires_grad_() for t in tensors
    ]
    return Lowered(Geometry(means, log_scales, quats), Cosine(W1, b1, w2, b2, 1.0, edge), Constant(rgb)), leaves


def camera(width: int, height: int) -> Camera:
    square = view(height)
    return Camera(square.viewmat, square.fx, square.fy, width / 2, height / 2, width, height)


def step_of(
    lowered: Lowered, leaves: list[torch.Tensor], cam: Camera, settings: RenderSettings
) -> tuple[Callable[[], Any], Callable[[], Any], Callable[[], Any]]:
    """A forward pass, a forward and backward pass, and a training step."""
    background = torch.zeros(3, device="cuda")
    target = torch.rand(cam.height, cam.width, 3, device="cuda")
    adam = torch.optim.Adam([x for x in leaves if x.numel()], lr=0.0, fused=True)

    def forward() -> None:
        with torch.no_grad():
            render_lowered(lowered, cam, settings, background)

    def both() -> None:
        out = render_lowered(lowered, cam, settings, background).rgb
        torch.autograd.grad(out, [x for x in leaves if x.numel()], target)

    def step() -> None:
        adam.zero_grad(set_to_none=True)
        loss = (render_lowered(lowered, cam, settings, background).rgb - target).abs().mean()
        loss.backward()
        adam.step()

    return forward, both, step


def times(counts: list[int], sizes: list[tuple[int, int]]) -> list[dict[str, Any]]:
    table, rows = (
        Table(
            "form",
            "primitives",
            "size",
            "pairs",
            "hits",
            "forward ms",
            "forward + backward",
            "step",
            "frames/s",
            "peak MB",
        ),
        [],
    )
    settings = RenderSettings(backend="cuda")
    for name, (K, p) in FORMS.items():
        for count in counts:
            lowered, leaves = scene_on(count, K, p)
            for width, height in sizes:
                cam = camera(width, height)
                torch.cuda.reset_peak_memory_stats()
                runs = step_of(lowered, leaves, cam, settings)
                stats = render_lowered(lowered, cam, settings).stats
                ms = [median_ms(run) for run in runs]
                peak = torch.cuda.max_memory_allocated() / 1e6
                row = {
                    "form": name,
                    "primitives": count,
                    "width": width,
                    "height": height,
                    "pairs": stats.pairs,
                    "slots": stats.extra["hits"],
                    "delicate": stats.extra["float64"],
                    "forward_ms": ms[0],
                    "both_ms": ms[1],
                    "step_ms": ms[2],
                    "peak_mb": peak,
                }
                rows.append(row)
                shown = [f"{x:.2f}" for x in ms]
                table.row(
                    name,
                    count,
                    f"{width}x{height}",
                    stats.pairs,
                    stats.extra["hits"],
                    *shown,
                    f"{1000 / ms[0]:.0f}",
                    f"{peak:.0f}",
                )
            del lowered, leaves
    return rows


def kernels(count: int, width: int, height: int) -> dict[str, dict[str, float]]:
    """Milliseconds of each kernel in a training step, by form."""
    found = {}
    for name, (K, p) in FORMS.items():
        lowered, leaves = scene_on(count, K, p)
        _, _, step = step_of(lowered, leaves, camera(width, height), RenderSettings(backend="cuda"))
        for _ in range(3):
            step()
        with torch.profiler.profile(
            activities=[torch.profiler.ProfilerActivity.CUDA, torch.profiler.ProfilerActivity.CPU]
        ) as seen:
            for _ in range(5):
                step()
            torch.cuda.synchronize()
        spent: dict[str, float] = {}
        for event in seen.events():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                label = re.sub(r"_[0-9a-f]{6,}.*", "", event.name)[:60]
                spent[label] = spent.get(label, 0.0) + event.device_time / 5e3
        found[name] = dict(sorted(spent.items(), key=lambda item: -item[1])[:24])
        print(f"{name}, {count} primitives, {width}x{height}: {sum(spent.values()):.2f} ms on the device in a step")
        for label, ms in list(found[name].items())[:16]:
            print(f"    {ms:7.3f}  {label}")
    return found


STEPS = {"chair": 2500, "fire": 4000, "smoke_fire": 4000, "lit_solids": 2600}
"""Those of the recorded rows of the other benchmarks."""


def train(names: list[str], folders: dict[str, Any]) -> list[dict[str, Any]]:
    from shared.forms import SCENES
    from shared.trials import Trial, begin

    from neuprim.runs.fit import train_to_end

    table, rows = Table("scene", "primitives", "steps", "ms a step", "PSNR", "of it"), []
    for name in names:
        scene = SCENES[name]
        words = (*scene.all_words(folders, name), "renderer.device=cuda")
        fitted = begin(Trial(name, words, STEPS[name]))
        while fitted.trainer.step < STEPS[name] // 2:  # kernels are compiled and views read in this half
            fitted.trainer.train_step()
        before = fitted.trainer.elapsed
        fitted = train_to_end(fitted)
        ms = 1e3 * (fitted.trainer.elapsed - before) / (STEPS[name] - STEPS[name] // 2)
        metrics = fitted.metrics()
        rows.append(
            {
                "scene": name,
                "primitives": fitted.model.count,
                "steps": STEPS[name],
                "step_ms": ms,
                "psnr": metrics[scene.judged],
                "of": scene.judged,
            }
        )
        table.row(name, fitted.model.count, STEPS[name], f"{ms:.2f}", f"{metrics[scene.judged]:.2f}", scene.judged)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--parts",
        nargs="*",
        default=["parity", "times", "kernels", "train"],
        choices=("parity", "times", "kernels", "train"),
    )
    parser.add_argument("--scenes", nargs="*", type=int, default=[5_000, 20_000, 100_000, 300_000, 1_000_000])
    parser.add_argument("--sizes", nargs="*", default=["800x800", "1920x1080"])
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"), help="of the part parity")
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--trained", nargs="*", default=["chair", "fire", "lit_solids"], choices=list(STEPS))
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    sizes = [tuple(int(x) for x in size.split("x")) for size in args.sizes]
    result: dict[str, Any] = {
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "Warp's CPU blocks",
        "torch": torch.__version__,
    }
    if "parity" in args.parts:
        result["parity"] = parity(args.device)
    if "times" in args.parts:
        result["times"] = times(args.scenes, sizes)
    if "kernels" in args.parts:
        result["kernels"] = kernels(max((c for c in args.scenes if c <= 100_000), default=args.scenes[0]), *sizes[0])
    if "train" in args.parts:
        result["train"] = train(args.trained, vars(args))
    path = RESULTS / (re.sub(r"[^a-z0-9]+", "_", result["device"].lower()).strip("_") + ".json")
    kept = json.loads(path.read_text()) if path.exists() else {}
    if args.record:
        RESULTS.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(kept | result, indent=1) + "\n")


if __name__ == "__main__":
    main()
