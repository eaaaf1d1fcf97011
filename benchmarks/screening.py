"""Which primitive is worth its bytes: every K and edge at the bytes of so many of the paper's primitives, judged by
what no test view shows.

    python benchmarks/screening.py --scenes solids [chair fire smoke_fire lit_solids] [--chair DIR] [--fire DIR]
        [--forms 8:0 2:2 ...] [--rates default ...] [--primitives 400] [--iterations 1500] [--set KEY=VALUE ...]

A form is K:EDGE; a soft edge has a gain. --rates tries further learning rates, each "KEY=VALUE+KEY=VALUE" of
train.rates; `amplitude` stands for b2 and w2, `frequency` for W1 and b1, a key with a dot for any setting. One seed,
one thread each. Test views stay unseen: every eighth training view is held out of a static scene or a relit one, a
volume takes another rig of cameras. Rows are kept in benchmarks/results/screening.json, and only what is missing is
trained. --docs puts the tables of the recorded grid between the markers of docs/expressivity.md; without --scenes
nothing is trained.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from shared.forms import AS_RECORDED, SCENES, Form
from shared.tables import ROOT, between_markers
from shared.trials import Trial, recorded, run_all

SHORT = {"amplitude": ("b2", "w2"), "frequency": ("W1", "b1")}
KEYS = (
    "psnr", "psnr_worst", "psnr_mask", "psnr_linear_clamped", "sigma_relative_l2_early", "sigma_relative_l2_middle", "sigma_relative_l2_late",
    "primitives", "parameters_per_primitive", "train_seconds",
)  # fmt: skip
GRID = "amplitude=0.03"
"""The rates at which every form of the table learns."""
RESULTS = Path(__file__).parent / "results" / "screening.json"


def rate_words(text: str) -> list[str]:
    if text == "default":
        return []
    words = []
    for part in text.split("+"):
        key, value = part.split("=")
        words += [part] if "." in key else [f"train.rates.{name}={value}" for name in SHORT.get(key, (key,))]
    return words


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=[], choices=sorted(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument(
        "--forms", nargs="+", default=[f"{k}:{p}" for k in (0, 1, 2, 4, 8, 16) for p in (0, 1, 2)], metavar="K:EDGE"
    )
    parser.add_argument("--rates", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--primitives", type=int, default=400, help="of the paper's form: K = 8, hard edge")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--record", type=Path, default=RESULTS)
    parser.add_argument("--docs", action="store_true")
    args = parser.parse_args()
    trials = []
    for seed in args.seeds:
        for text in args.forms:
            for rates in args.rates:
                for name in args.scenes:
                    scene = SCENES[name]
                    count = Form.named(text).equal_bytes(args.primitives, scene.task, args.set)
                    words = (
                        *scene.all_words(vars(args), name), *AS_RECORDED, *scene.tuning, *Form.named(text).words, f"model.primitives={count}", *rate_words(rates), *args.set
                    )  # fmt: skip
                    title = "-".join(
                        [name, text, rates, str(count), str(args.iterations), str(seed), *sorted(args.set)]
                    )
                    facts = (
                        ("scene", name),
                        ("form", text),
                        ("rates", rates),
                        ("set", " ".join(sorted(args.set))),
                        ("of", args.primitives),
                    )
                    trials.append(Trial(title, words, args.iterations, seed, 8 if scene.task == "static" else 0, facts))
    run_all(trials, args.record, KEYS, args.jobs, lambda row: f"{row['psnr']:.2f} dB")
    wanted = {trial.name for trial in trials}
    for row in sorted(
        (r for r in recorded(args.record) if r["trial"] in wanted),
        key=lambda r: (r["scene"], -r[SCENES[r["scene"]].judged]),
    ):
        judged = row[SCENES[row["scene"]].judged]
        print(
            f"{row['scene']:10} {row['form']:5} {row['rates']:44} {row['primitives']:5} {judged:.2f} dB, PSNR {row['psnr']:.2f}, worst {row['psnr_worst']:.2f}"
        )
    if args.record == RESULTS:
        text = grid_table(recorded(args.record))
        print(f"\n{text}")
    if args.record == RESULTS and args.docs:
        between_markers(ROOT / "docs" / "expressivity.md", "screening", text)


def grid_table(rows: list[dict[str, Any]]) -> str:
    """K down, edges across, the judged PSNR of the first scenes' grids in each cell."""
    own = [r for r in rows if r["rates"] == GRID and not r["set"] and r["of"] == 400 and r["iterations"] == 1500]
    scenes = [name for name in SCENES if any(r["scene"] == name for r in own)]
    found = {(r["scene"], r["form"]): r[SCENES[r["scene"]].judged] for r in own if r["seed"] == 0}
    best = {scene: max(value for (name, _), value in found.items() if name == scene) for scene in scenes}
    edges = sorted({Form.named(form).edge for _, form in found})
    lines = [
        f"| {' / '.join(scenes)} | " + " | ".join(f"p = {p}" for p in edges) + " |",
        "| --- |" + " --- |" * len(edges),
    ]

    def cell(scene: str, form: str) -> str:
        if (scene, form) not in found:
            return "–"
        value = found[scene, form]
        return f"**{value:.2f}**" if value > best[scene] - 0.1 else f"{value:.2f}"

    for k in sorted({Form.named(form).neurons for _, form in found}):
        lines.append(
            f"| K = {k} | " + " | ".join(" / ".join(cell(scene, f"{k}:{p}") for scene in scenes) for p in edges) + " |"
        )
    lines.append(
        "\nPSNR in dB; bold: within 0.1 dB of the best. b2 and w2 learn at 0.03 throughout; a soft edge has a gain."
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
