"""What a volume model is worth in voxels: images, voxels or both to learn from, several densities, at equal bytes and
equal steps.

    python benchmarks/voxels.py DIR [--frames 1:40] [--iterations 2500] [--seeds 3] [--kilobytes 1240] [--forms ...]
    [--from ...] [--docs]

DIR is a folder of .vdb files of JangaFX EmberGen (the recorded numbers: a free fire animation, frames 1 to 40), seen by
40 cameras at 96 x 96, two of them held out. Each form gets as many primitives as fit into the bytes in float32. Errors
of sigma are those of metrics.json: on all of the files' own voxels in the sequence's box, means over three frames of
each third. Images are judged by held-out cameras, inside the union mask. All runs take equally many steps; --seconds
gives each as many seconds instead.

Eight bits: every column of every parameter in 256 even steps between two of its quantiles, those of 0, 0.0001, 0.001
and 0.01 at each end that leave the least mean square; primitives along a Morton curve, columns one by one through zlib.
The numbers after them are measured on what comes back. Everything runs on one thread. Results go to
benchmarks/results/voxels.json, run by run; --docs puts the table between the markers of docs/dynamic.md. Without DIR
nothing is run. Time is that of the processor, as a machine may be busy with other things.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from shared.tables import ROOT, Table, between_markers, spread

from neuprim.config import compose
from neuprim.core.compression import order as curve
from neuprim.core.compute.machine import cpu_name
from neuprim.core.model.primitives import Primitives
from neuprim.runs.fit import Fitted, compile_kernels, complete, start

RESULTS = Path(__file__).parent / "results" / "voxels.json"
SIZE = 96
SOFT = ("model.density.edge=2", "model.density.gain=true")
FORMS = {
    "K = 8, p = 0": ("model.neurons=8", "model.density.edge=0", "model.density.gain=false"),
    "K = 0, p = 2, gain": ("model.neurons=0", *SOFT),
    "K = 2, p = 2, gain": ("model.neurons=2", *SOFT),
}
"""All with the starting values and rates of the preset quick."""

SOURCES = {
    "images": ("train.supervision=images",),
    "both": ("train.supervision=both",),
    "both, every step": ("train.supervision=both", "train.voxels_every=1"),
    "voxels": ("train.supervision=voxels",),
}
"""What is learned from; ``both`` takes points as often as the preset says."""

COMPARED = {
    "K = 8, p = 0": ("images", "both, every step"),
    "K = 0, p = 2, gain": tuple(SOURCES),
    "K = 2, p = 2, gain": ("both, every step",),
}
THIRDS = ("early", "middle", "late")
KEYS = (
    "psnr_mask",
    "psnr_pooled_mask",
    *(f"sigma_{k}_{t}" for k in ("relative_l2", "psnr_active", "max_error") for t in THIRDS),
)
CLIPS = (0.0, 1e-4, 1e-3, 1e-2)


def eight_bits(model: Primitives) -> tuple[Primitives, int]:
    """The model as 8-bit columns give it back, and the bytes that these take."""
    order = torch.from_numpy(np.argsort(morton(model.params["means"].detach().numpy()), kind="stable"))
    params, size = {}, 0
    for name, value in model.params.items():
        columns = value.detach()[order].reshape(model.count, -1).double().numpy()
        made = np.empty_like(columns)
        for c in range(columns.shape[1]):
            codes, made[:, c] = coded(columns[:, c])
            size += len(zlib.compress(codes.tobytes(), 9)) + 8  # and the two ends
        params[name] = torch.from_numpy(made).float().reshape(value.shape)
    return Primitives(model.density, model.colour, params), size


def coded(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """uint8 codes of a column, and what they stand for."""
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for clip in CLIPS:
        low, high = np.quantile(x, [clip, 1 - clip]).astype(np.float32).astype(np.float64)
        step = (high - low) / 255 or 1.0
        codes = np.rint((x - low) / step).clip(0, 255)
        error = float(np.square(low + codes * step - x).mean())
        if best is None or error < best[0]:
            best = error, codes.astype(np.uint8), low + codes * step
    assert best is not None
    return best[1], best[2]


def morton(points: np.ndarray) -> np.ndarray:
    """Places along a Z curve of 2^30 cells."""
    low, high = points.min(0), points.max(0)
    cells = ((points - low) / np.maximum(high - low, 1e-9) * 1023).astype(np.int64)
    return curve.morton(cells, 10)


def measured(fitted: Fitted, model: Primitives) -> dict[str, Any]:
    """The numbers of a model under a run's configuration."""
    own = fitted.trainer.model
    fitted.trainer.model = model
    found = fitted.metrics()
    fitted.trainer.model = own
    return {key: found[key] for key in KEYS}


def one(words: list[str], form: str, source: str, kilobytes: float) -> dict[str, Any]:
    """Fit, measure, store in 8 bits, measure again."""
    torch.set_num_threads(1)
    named = [*words, *FORMS[form], *SOURCES[source]]
    few = start(compose([*named, "model.primitives=8"], check_output=False))
    count = int(kilobytes * 1000 / 4 / few.model.parameters_per_primitive)
    fitted = start(compose([*named, f"model.primitives={count}"], check_output=False), dataset=few.dataset)
    compile_kernels(fitted.trainer)
    begin = time.process_time()
    complete(fitted)
    busy = time.process_time() - begin
    coarse, size = eight_bits(fitted.model)
    return {
        "form": form,
        "source": source,
        "kilobytes": 4 * fitted.model.count * fitted.model.parameters_per_primitive / 1000,
        "primitives": count,
        "iterations": fitted.trainer.step,
        "seconds": fitted.trainer.elapsed,
        "cpu_seconds": busy,
        "seed": fitted.config.seed,
        "float32": measured(fitted, fitted.model),
        "kilobytes_8bit": size / 1000,
        "8bit": measured(fitted, coarse),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--frames", default="1:40")
    parser.add_argument("--iterations", type=int, default=2500)
    parser.add_argument("--seconds", type=float, help="of training for each run, instead of --iterations")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--kilobytes", type=float, nargs="*", default=[1240.0], help="of a model in float32")
    parser.add_argument("--forms", nargs="*", default=list(FORMS), choices=list(FORMS))
    parser.add_argument(
        "--from",
        dest="sources",
        nargs="*",
        default=[],
        choices=list(SOURCES),
        help="for every form, instead of the usual",
    )
    parser.add_argument("--docs", action="store_true")
    args = parser.parse_args()
    recorded: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"runs": []}
    if args.folder:
        recorded["cpu"] = cpu_name()
        budget = ["train.max_seconds=null", f"train.iterations={args.iterations}"]
        if args.seconds:
            budget = [f"train.max_seconds={args.seconds}", "train.iterations=1000000"]
        data = [
            "task=dynamic", "scene=vdb", f"scene.vdb='{args.folder.resolve()}'", f"scene.frames='{args.frames}'", "scene.look=embergen_fire",
            f"scene.size={SIZE}", "train.eval_every=0", "renderer.threads=1", *budget,
        ]  # fmt: skip
        for seed in range(args.seeds):
            for kilobytes in args.kilobytes:
                for form in args.forms:
                    for source in args.sources or COMPARED[form]:
                        entry = one([*data, f"seed={seed}"], form, source, kilobytes) | {
                            "asked": kilobytes,
                            "budget": budget[0] + budget[1],
                        }
                        recorded |= (
                            json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
                        )  # another process may add to it
                        recorded["runs"] = [r for r in recorded["runs"] if _key(r) != _key(entry)] + [entry]
                        RESULTS.write_text(
                            json.dumps(recorded, indent=1) + "\n"
                        )  # after every run: a long benchmark may be cut short
                        print(json.dumps(entry), flush=True)
    text = table(recorded)
    if args.docs:
        between_markers(ROOT / "docs" / "dynamic.md", "voxels", text)


def _key(run: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(run[k] for k in ("form", "source", "asked", "budget", "seed"))


def table(recorded: Mapping[str, Any]) -> str:
    """One row per form, source and size."""
    runs = recorded["runs"]
    if not runs:
        return "not measured"
    made = Table(
        "density", "learned from", "kB, float32 / 8 bits", "relative L2 of σ, early / middle / late", "after 8 bits",
        "PSNR of σ, active voxels", "largest error, of the peak", "images inside the mask", "after 8 bits", "ms of a core a step",
    )  # fmt: skip
    for key in dict.fromkeys(_key(r)[:4] for r in runs):
        own = [r for r in runs if _key(r)[:4] == key]

        def cells(name: str, digits: int, kind: str = "float32", own: list[dict[str, Any]] = own) -> str:
            return " / ".join(spread([r[kind][f"sigma_{name}_{third}"] for r in own], digits) for third in THIRDS)

        made.row(
            own[0]["form"],
            own[0]["source"],
            f"{np.mean([r['kilobytes'] for r in own]):,.0f} / {np.mean([r['kilobytes_8bit'] for r in own]):,.0f}",
            cells("relative_l2", 3),
            cells("relative_l2", 3, "8bit"),
            cells("psnr_active", 1) + " dB",
            cells("max_error", 2),
            f"{spread([r['float32']['psnr_mask'] for r in own], 2)} dB",
            f"{spread([r['8bit']['psnr_mask'] for r in own], 2)} dB",
            f"{1e3 * np.mean([r['cpu_seconds'] / r['iterations'] for r in own]):.0f}"
            if all("cpu_seconds" in r for r in own)
            else "–",
        )
    steps = " to ".join(
        f"{n:,}" for n in sorted({min(r["iterations"] for r in runs), max(r["iterations"] for r in runs)})
    )
    return f"{made}\n\n{steps} steps, {len({r['seed'] for r in runs})} seed(s), one thread of {recorded['cpu']}."


if __name__ == "__main__":
    main()
