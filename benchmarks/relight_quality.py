"""Quality of the relighting task on `lit_solids`: ways of colouring at equal training time, where shadows come from,
and losses.

    python benchmarks/relight_quality.py [--steps 2600] [--seeds 3] [--parts forms losses] [--variants ...] [--once ...]
    [--continue] [--tune] [--docs]

Parts:

    forms      a constant colour, spherical harmonics of the light (a baseline with the network's number of parameters),
    equation 14 as
               printed, and equation 14 or its multiplicative form with a light visibility per primitive or per pixel
    losses     the default form under every loss

Equal seconds are counted in steps: all variants take turns with the default on this machine first, and each then trains
for as many steps as it makes while the default makes --steps, so that neither other work on the machine nor its speed
disturbs the comparisons. Images are 128 x 128, 500 for training, 100 held out (new lights, new views, both), linear
light over the exposure, clamped to 0..1, black background; means over seeds +- half the spread, of the last checkpoint.
--tune tests on every eighth training view instead. Results go to benchmarks/results/relight_quality.json. --docs puts
the table between the markers of docs/relighting.md; with --parts none nothing is run, and the table is made of the
recorded results.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from shared.tables import ROOT, between_markers, spread
from shared.trials import paces_of

from neuprim.config import compose
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.data import Dataset
from neuprim.runs.fit import Fitted, compile_kernels, prepare_training, train_to_end
from neuprim.tasks.relight.evaluation import baselines

RESULTS = Path(__file__).parent / "results" / "relight_quality.json"
PLAIN = "model.colour.visibility=none"
FORMS = {
    "constant colour": ("model.colour.hidden=0", PLAIN),
    "harmonics of the light, degree 5": ("model.colour.form=harmonics",),
    "equation 14": (PLAIN,),
    "equation 14, visibility per primitive": ("model.colour.visibility=primitive",),
    "equation 14, visibility per pixel": ("model.colour.visibility=pixel",),
    "multiplicative, visibility per pixel": ("model.colour.form=multiplicative", "model.colour.visibility=pixel"),
    "multiplicative, visibility per primitive": (
        "model.colour.form=multiplicative",
        "model.colour.visibility=primitive",
    ),
}
LOSSES = {loss: (f"train.loss={loss}",) for loss in ("l1", "compressed", "relative")}
BASELINES = {
    "black": "black image",
    "no_cast_shadows": "perfect shading without cast shadows",
    "nearest_light_of_25": "nearest light of 25, same camera",
}
DEFAULT = "equation 14, visibility per primitive"
SIZE = 128
CLASSES = ("lit", "cast_shadow", "attached_shadow", "highlight")
KEYS = (
    "psnr_linear_clamped",
    "psnr_display",
    "ssim_display",
    *(f"psnr_pooled_{c}" for c in CLASSES),
    "psnr_linear_clamped_new_view",
    "psnr_linear_clamped_new_light",
    "psnr_linear_clamped_new_both",
    "primitives",
    "parameters_per_primitive",
    "iterations",
    "train_seconds",
    "seed",
)


def prepared(words: list[str], dataset: Dataset | None) -> Fitted:
    config = compose(
        [
            "task=relight",
            "scene=lit_solids",
            f"scene.size={SIZE}",
            "train.eval_every=0",
            "train.max_seconds=null",
            *words,
        ],
        check_output=False,
    )
    fitted = prepare_training(config, dataset=dataset)
    compile_kernels(fitted.trainer)
    return fitted


def pace(variants: dict[str, list[str]], dataset: Dataset) -> dict[str, float]:
    """Seconds a step of each, see :func:`~shared.trials.paces_of`."""
    return paces_of({name: prepared(words, dataset).trainer for name, words in variants.items()})


def fit(words: list[str], dataset: Dataset) -> dict[str, Any]:
    found = train_to_end(prepared(words, dataset)).metrics()
    return {k: found[k] for k in KEYS if k in found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2600, help="of the default form; the others train as long")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--parts", nargs="*", default=["forms", "losses"], help="none: print what is recorded")
    parser.add_argument("--variants", nargs="*", default=list(FORMS))
    parser.add_argument("--once", nargs="*", default=[], help="variants that run with the first seed only")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument(
        "--continue", dest="go_on", action="store_true", help="keep recorded runs and paces; add what is missing"
    )
    parser.add_argument("--tune", action="store_true", help="held-out training views; nothing is recorded")
    parser.add_argument("--docs", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    recorded: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    common = [*args.set, *(["scene.hold_out=8"] if args.tune else [])]
    wanted: dict[str, dict[str, list[str]]] = {}
    if "forms" in args.parts:
        wanted["forms"] = {name: [*FORMS[name], *common] for name in args.variants}
    if "losses" in args.parts:
        wanted["losses"] = {name: [*words, *common] for name, words in LOSSES.items()}
    if wanted:
        dataset = prepared(common, None).dataset
        everything = {(part, name): words for part, own in wanted.items() for name, words in own.items()}
        known = (
            {f"{part}: {e['name']}": e["pace"] for part in wanted for e in recorded.get(part, []) if "pace" in e}
            if args.go_on
            else {}
        )
        missing = {
            f"{part}: {name}": words for (part, name), words in everything.items() if f"{part}: {name}" not in known
        }
        took = pace({"": [*FORMS[DEFAULT], *common], **missing}, dataset) if missing else {}
        paces = {**{name: took[name] / took[""] for name in missing}, **known}
        recorded |= {"cpu": cpu_name(), "cores": core_count(), "steps": args.steps, "baselines": baselines(dataset)}
        for part, own in wanted.items():
            recorded[part] = [e for e in recorded.get(part, []) if args.go_on or e["name"] not in own]
        for seed in range(args.seeds):
            for (part, name), words in everything.items():
                there = any((e["name"], e["seed"]) == (name, seed) for e in recorded[part])
                if there or (seed and (name in args.once or part in args.once)):
                    continue
                each = paces[f"{part}: {name}"]
                found = fit([*words, f"train.iterations={round(args.steps / each)}", f"seed={seed}"], dataset)
                recorded[part].append({"name": name, "pace": each, **found})
                print(
                    part,
                    json.dumps({k: round(v, 3) if isinstance(v, float) else v for k, v in recorded[part][-1].items()}),
                    flush=True,
                )
                if not args.tune:
                    RESULTS.write_text(
                        json.dumps(recorded, indent=1) + "\n"
                    )  # after every run: a long benchmark may be cut short
    table = quality_table(recorded)
    print(f"\n{table}")
    if args.docs:
        between_markers(ROOT / "docs" / "relighting.md", "relight-quality", table)


def quality_table(recorded: dict[str, Any]) -> str:
    """One row per baseline, form and loss."""
    lines = [
        "| `lit_solids`, equally long training | numbers per primitive | PSNR | lit | cast shadow | attached "
        "shadow | highlight | PSNR display | steps |",
        "| --- |" + " --- |" * 8,
    ]
    for key, name in BASELINES.items():
        b = recorded["baselines"][key]
        pooled = " | ".join(f"{b[f'psnr_pooled_{c}']:.1f}" for c in CLASSES)
        lines.append(f"| *{name}* |  | {b['psnr_linear_clamped']:.1f} | {pooled} | {b['psnr_display']:.1f} |  |")
    for part, prefix in (("forms", ""), ("losses", "default form, loss ")):
        for name in dict.fromkeys(e["name"] for e in recorded.get(part, [])):
            own = [e for e in recorded[part] if e["name"] == name]

            def cell(key: str, digits: int, own: list[dict[str, Any]] = own) -> str:
                return spread([e[key] for e in own], digits)

            pooled = " | ".join(cell(f"psnr_pooled_{c}", 1) for c in CLASSES)
            lines.append(
                f"| {prefix}{name} | {own[0]['parameters_per_primitive']} | {cell('psnr_linear_clamped', 2)} | "
                f"{pooled} "
                f"| {cell('psnr_display', 2)} | {own[0]['iterations']:,} |"
            )
    seeds = len({e["seed"] for e in recorded.get("forms", recorded.get("losses", []))})
    counts = sorted({e["primitives"] for e in recorded.get("forms", [])})
    lines.append(
        f"\n{' or '.join(f'{n:,}' for n in counts)} primitives of equal bytes; rows with ± are means over {seeds} "
        f"seeds, others one run; {recorded['cores']} cores of {recorded['cpu']}."
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
