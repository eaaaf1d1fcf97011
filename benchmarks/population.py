"""Ways to control the population at equal time: who moves, where to, and whether the count grows.

    python benchmarks/population.py [--scenes chair smoke_fire fire] [--chair DIR] [--fire DIR] [--steps 2500] [--seeds
    3] [--docs] [--print]

Each is its task's preset `quick` with another population and no cool-down of the rates; all end with the same number of
primitives, and each trains for as long as the preset takes for --steps, at paces measured in turns over whole runs of
one thread. Variants:

    fixed       nobody moves
    always      `relocate`: the least used move, however much they do
    idle        `relocate` of the idle alone (weight below 0.05 of the mean); what dynamic's `quick` does
    weight      as `idle`, but split are those drawn at random in proportion to their weight in the images, as in MCMC
    (Kheradmand et al. 2024) grown       half of the primitives at first, the others are born where the error is
    largest; then as `idle`; static's `quick` does so

Results on the test views go to benchmarks/results/population.json after every run, and only what is missing is run;
--docs puts the table between the markers of docs/budgets.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from shared.forms import AS_RECORDED, SCENES
from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, begin, paces_of, recorded
from torch import Tensor

from neuprim.core.compute.machine import cpu_name
from neuprim.core.model.primitives import Primitives
from neuprim.core.train import population
from neuprim.core.train.population import Change
from neuprim.core.train.population.relocate import Relocate
from neuprim.core.train.settings import PopulationSettings
from neuprim.runs.fit import compile_kernels, complete

RESULTS = Path(__file__).parent / "results" / "population.json"
IDLE = ("train.population.strategy=relocate", "train.population.idle=0.05")
VARIANTS: dict[str, tuple[str, ...]] = {
    "fixed": ("train.population.strategy=fixed",),
    "always": ("train.population.strategy=relocate", "train.population.idle=null"),
    "idle": IDLE,
    "weight": ("train.population.strategy=by_weight", "train.population.idle=0.05"),
    "grown": (*IDLE, "train.population.grow_from=0.5"),
}
TITLES = {
    "fixed": "nobody moves",
    "always": "the least used move to the largest error",
    "idle": "the idle move to the largest error",
    "weight": "the idle move to others drawn by weight, as in MCMC",
    "grown": "half at first, the rest born at the largest error",
}


class ByWeight(Relocate):
    """Primitives that split are drawn in proportion to their weight; the errors that :class:`Relocate` sorts by become
    the draw's order."""

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.generator = torch.Generator().manual_seed(0)

    def intervene(self, model: Primitives, extent: float) -> Change | None:
        if self.weight is not None:
            # the largest of u^(1/w) is a draw without replacement in proportion to w (Efraimidis and Spirakis 2006)
            u: Tensor = torch.rand(model.count, generator=self.generator, dtype=torch.float64)
            self.error = (u.log() / self.weight.double().clamp_min(1e-12)).exp().float()
        return super().intervene(model, extent)


def words_of(args: argparse.Namespace, scene: str, variant: str) -> tuple[str, ...]:
    return (*SCENES[scene].all_words(vars(args), scene), *AS_RECORDED, *VARIANTS[variant])


def run(args: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    population.TABLE["by_weight"] = ByWeight
    kept: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"trials": [], "paces": {}}
    kept["cpu"] = cpu_name()
    for scene in args.scenes:
        words = {variant: words_of(args, scene, variant) for variant in VARIANTS}
        if not all(f"{scene} {variant}" in kept["paces"] for variant in VARIANTS):
            took = paces_of(
                {v: begin(Trial("", own, args.steps, interventions=None)).trainer for v, own in words.items()},
                args.steps,
            )
            own_pace = took["idle" if SCENES[scene].task == "dynamic" else "always"]
            kept["paces"] |= {f"{scene} {variant}": seconds / own_pace for variant, seconds in took.items()}
        for seed in range(args.seeds):
            for variant, own in words.items():
                steps = round(args.steps / kept["paces"][f"{scene} {variant}"])
                name = f"{scene}-{variant}-{args.steps}-{seed}"
                if any(row["trial"] == name for row in kept["trials"]):
                    continue
                fitted = begin(Trial(name, own, steps, seed, interventions=None))
                compile_kernels(fitted.trainer)
                metrics = complete(fitted).metrics()
                row = {
                    "trial": name,
                    "scene": scene,
                    "variant": variant,
                    "seed": seed,
                    "steps": args.steps,
                    "iterations": steps,
                }
                row |= {
                    k: metrics[k]
                    for k in ("psnr", "psnr_worst", "psnr_mask", "psnr_linear_clamped", "primitives")
                    if k in metrics
                }
                kept["trials"].append(row)
                RESULTS.write_text(json.dumps(kept, indent=1) + "\n")
                print(f"{name}: {row[SCENES[scene].judged]:.2f} dB, {row['primitives']} primitives", flush=True)


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    scenes = [scene for scene in SCENES if any(row["scene"] == scene for row in rows)]
    budget = max(row["steps"] for row in rows)
    judged = {scene: "inside the mask" if SCENES[scene].judged == "psnr_mask" else "all pixels" for scene in scenes}
    made = Table("population", *(f"{scene}, {judged[scene]}" for scene in scenes))
    for variant, title in TITLES.items():
        cells = []
        for scene in scenes:
            own = [row for row in rows if (row["scene"], row["variant"], row["steps"]) == (scene, variant, budget)]
            cells.append(f"{spread([row[SCENES[scene].judged] for row in own], 2)} dB" if own else "")
        made.row(title, *cells)
    return made


def caption(rows: Sequence[Mapping[str, Any]]) -> str:
    seeds = {row["scene"]: len({other["seed"] for other in rows if other["scene"] == row["scene"]}) for row in rows}
    counts = ", ".join(f"{scene}: {number} seed(s)" for scene, number in seeds.items())
    return f"The time of {max(row['steps'] for row in rows):,} steps of the preset, one thread of {json.loads(RESULTS.read_text())['cpu']}; {counts}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["chair", "smoke_fire", "fire"], choices=sorted(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        for name in args.scenes:
            if SCENES[name].folder and not getattr(args, name):
                parser.error(f"--{name}: wants the folder of its data; or leave it out of --scenes")
        run(args)
    made = table(recorded(RESULTS))
    if args.docs:
        between_markers(ROOT / "docs" / "budgets.md", "population", f"{made}\n\n{caption(recorded(RESULTS))}")


if __name__ == "__main__":
    main()
