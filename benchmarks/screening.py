"""A first look at which primitive is worth its bytes: one seed, every K and edge at the bytes of so many neural primitives.

    python benchmarks/screening.py [DIR] [--forms 8:0:0 2:2:1 ...] [--primitives 400] [--iterations 1500]

A form is K:EDGE:GAIN. Trains the static task's preset `quick` on `solids` and, if DIR is given, on that NeRF-synthetic folder, for a number of
steps, one thread each; amplitudes learn at 0.03 throughout. PSNR of the test views: what is chosen by this is to be confirmed on
views held out of the training ones, with several seeds. Prints a table and writes nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from shared.tables import Table

from neuprim.config import compose
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.runs.fit import fit

GEOMETRY_AND_COLOUR = 10 + 48
DEFAULT = ("8:0:0", "8:1:1", "8:2:1", "4:1:1", "4:2:1", "2:1:1", "2:2:1", "0:1:1", "0:2:1")


def parameters(neurons: int, gain: bool) -> int:
    return GEOMETRY_AND_COLOUR + sum(spec.size for spec in CosineDensity(neurons, gain=gain).parameters())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--forms", nargs="*", default=DEFAULT, metavar="K:EDGE:GAIN")
    parser.add_argument("--primitives", type=int, default=400, help="of the paper's form, K = 8 with a hard edge")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    scenes = [["scene=solids", f"scene.size={args.size}"]]
    if args.folder is not None:
        scenes.append(["scene=blender", f"scene.path='{args.folder.resolve()}'"])
    table = Table("scene", "K", "edge", "gain", "primitives", "PSNR", "worst view")
    for form in args.forms:
        neurons, edge, gain = (int(x) for x in form.split(":"))
        count = round(args.primitives * parameters(8, False) / parameters(neurons, bool(gain)))
        words = [
            "task=static", f"model.neurons={neurons}", f"model.density.edge={edge}", f"model.density.gain={'true' if gain else 'false'}",
            f"model.primitives={count}", f"seed={args.seed}", "train.background=white", f"train.iterations={args.iterations}",
            "train.max_seconds=null", f"train.population.every={max(args.iterations // 20, 1)}", "train.rates.b2=0.03", "train.rates.w2=0.03",
            "renderer.threads=1",
        ]  # fmt: skip
        for scene in scenes:
            metrics = fit(compose([*words, *scene], check_output=False)).metrics()
            table.row(scene[0], neurons, edge, bool(gain), count, f"{metrics['psnr']:.2f}", f"{metrics['psnr_worst']:.2f}")


if __name__ == "__main__":
    main()
