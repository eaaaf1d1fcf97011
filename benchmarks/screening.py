"""Which primitive is worth its bytes: every K and edge at the bytes of so many of the paper's primitives, judged by what no test view shows.

    python benchmarks/screening.py --scenes solids [chair fire smoke_fire lit_solids] [--chair DIR] [--fire DIR]
        [--forms 8:0 2:2 ...] [--rates default ...] [--primitives 400] [--iterations 1500] [--set KEY=VALUE ...]

A form is K:EDGE; a soft edge has a gain. --rates tries further learning rates, each "KEY=VALUE+KEY=VALUE" of train.rates; `amplitude` stands for b2 and w2,
`frequency` for W1 and b1, a key with a dot for any setting. One seed, one thread each. Test views stay unseen: every eighth training view is held out
of a static scene or a relit one, a volume takes another rig of cameras. Rows are kept in --record, and only what is missing is trained.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from shared.forms import SCENES, Form
from shared.trials import Trial, recorded, run_all

SHORT = {"amplitude": ("b2", "w2"), "frequency": ("W1", "b1")}
KEYS = ("psnr", "psnr_worst", "psnr_mask", "psnr_linear_clamped", "primitives", "parameters_per_primitive", "train_seconds")


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
    parser.add_argument("--scenes", nargs="+", required=True, choices=sorted(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--forms", nargs="+", default=[f"{k}:{p}" for k in (0, 1, 2, 4, 8, 16) for p in (0, 1, 2)], metavar="K:EDGE")
    parser.add_argument("--rates", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--primitives", type=int, default=400, help="of the paper's form: K = 8, hard edge")
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--record", type=Path, default=Path("outputs") / "screening.json")
    args = parser.parse_args()
    trials = []
    for seed in args.seeds:
        for text in args.forms:
            for rates in args.rates:
                for name in args.scenes:
                    scene = SCENES[name]
                    count = Form.named(text).equal_bytes(args.primitives, scene.task, args.set)
                    words = (
                        *scene.all_words(vars(args), name), *scene.tuning, *Form.named(text).words, f"model.primitives={count}", *rate_words(rates), *args.set
                    )  # fmt: skip
                    title = "-".join([name, text, rates, str(count), str(args.iterations), str(seed), *sorted(args.set)])
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
        (r for r in recorded(args.record) if r["trial"] in wanted), key=lambda r: (r["scene"], -r[SCENES[r["scene"]].judged])
    ):
        judged = row[SCENES[row["scene"]].judged]
        print(
            f"{row['scene']:10} {row['form']:5} {row['rates']:44} {row['primitives']:5} {judged:.2f} dB, PSNR {row['psnr']:.2f}, worst {row['psnr_worst']:.2f}"
        )


if __name__ == "__main__":
    main()
