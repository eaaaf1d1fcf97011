"""Quality of the relighting task on `lit_solids`: ways of colouring at equal training time, where shadows come from,
and losses.

    python benchmarks/relight_quality.py [--steps 2600] [--seeds 3] [--variants NAME ...] [--once NAME ...] [--jobs 2]
    [--docs] [--print]

The forms are a constant colour, spherical harmonics of the light (a baseline with the network's number of parameters),
equation 14 as printed, and equation 14 or its multiplicative form with a light visibility per primitive or per pixel;
the losses train the default form.

Equal seconds are counted in steps: all variants take turns with the default on this machine first, and each then trains
for as many steps as it makes while the default makes --steps, so that neither other work on the machine nor its speed
disturbs the comparisons. Images are 128 x 128, 500 for training, 100 held out (new lights, new views, both), linear
light over the exposure, clamped to 0..1, black background; means over seeds +- half the spread, of the last checkpoint.
Results go to benchmarks/results/relight_quality.json after every run, and only what is missing is run. --docs puts the
table between the markers of docs/relighting.md; --print runs nothing.
"""

from __future__ import annotations

from typing import Any

from shared.arguments import make_parser
from shared.tables import DOCS, RESULTS, Run, Table, between_markers, group_runs, read_record, spread_of
from shared.trials import Trial, begin, measure_paces, run_all

from neuprim.core.compute.threads import cpu_name
from neuprim.tasks.relight import lighting_baseline_scores

RECORD = RESULTS / "relight_quality.json"
WORDS = ("task=relight", "scene=lit_solids", "scene.size=128")
PLAIN = "model.colour.visibility=none"
DEFAULT = "equation 14, visibility per primitive"
FORMS: dict[str, tuple[str, ...]] = {
    "constant colour": ("model.colour.hidden=0", PLAIN),
    "harmonics of the light, degree 5": ("model.colour.form=harmonics",),
    "equation 14": (PLAIN,),
    DEFAULT: ("model.colour.visibility=primitive",),
    "equation 14, visibility per pixel": ("model.colour.visibility=pixel",),
    "multiplicative, visibility per pixel": ("model.colour.form=multiplicative", "model.colour.visibility=pixel"),
    "multiplicative, visibility per primitive": (
        "model.colour.form=multiplicative",
        "model.colour.visibility=primitive",
    ),
}
LOSSES = {loss: (f"train.loss={loss}",) for loss in ("l1", "compressed", "relative")}
VARIANTS = FORMS | LOSSES
BASELINES = {
    "black": "black image",
    "no_cast_shadows": "perfect shading without cast shadows",
    "nearest_light_of_25": "nearest light of 25, same camera",
}
POOLED = tuple(f"psnr_pooled_{name}" for name in ("lit", "cast_shadow", "attached_shadow", "highlight"))
KEYS = (
    *("psnr", "psnr_linear_clamped", "psnr_display", "ssim_display", *POOLED),
    *(f"psnr_linear_clamped_new_{what}" for what in ("view", "light", "both")),
    *("primitives", "parameters_per_primitive", "train_seconds"),
)


def quality_table(record: dict[str, Any]) -> str:
    """One row per baseline, form and loss."""
    heads = ("PSNR", "lit", "cast shadow", "attached shadow", "highlight", "PSNR display", "steps")
    table = Table("`lit_solids`, equally long training", "numbers per primitive", *heads)
    for key, name in BASELINES.items():
        scores = record["baselines"][key]
        table.row(f"*{name}*", "", *(f"{scores[k]:.1f}" for k in (KEYS[1], *POOLED, "psnr_display")), "")
    groups = group_runs(record["trials"], "form")
    for name in VARIANTS:
        own: list[Run] = groups.get((name,), [])
        if own:
            cells = [spread_of(own, "psnr_linear_clamped"), *(spread_of(own, key, 1) for key in POOLED)]
            title = f"default form, loss {name}" if name in LOSSES else name
            numbers, steps = own[0]["parameters_per_primitive"], f"{own[0]['iterations']:,}"
            table.row(title, numbers, *cells, spread_of(own, "psnr_display"), steps)
    counts = " or ".join(f"{n:,}" for n in sorted({run["primitives"] for run in record["trials"]}))
    seeds = len({run["seed"] for run in record["trials"]})
    return (
        f"{table}\n\n{counts} primitives of equal bytes; rows with ± are means over {seeds} seeds, others one run; "
        f"{record['machine']}."
    )


def main() -> None:
    parser = make_parser(__doc__, "--seeds", "--jobs", "--docs", "--print")
    parser.add_argument("--steps", type=int, default=2600, help="of the default form; the others train as long")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS), metavar="NAME")
    parser.add_argument("--once", nargs="*", default=[], help="variants that run with the first seed only")
    args = parser.parse_args()
    if not args.only_print:
        trials = {name: Trial("", (*WORDS, *VARIANTS[name]), args.steps, interventions=None) for name in args.variants}
        reference = Trial("", (*WORDS, *FORMS[DEFAULT]), args.steps, interventions=None)
        paces = measure_paces(RECORD, reference, trials, 480)
        found = {"steps": args.steps, "baselines": lighting_baseline_scores(begin(reference).dataset)}
        runs = []
        for seed in range(args.seeds):
            for name, trial in trials.items():
                if not seed or name not in args.once:
                    part = "forms" if name in FORMS else "losses"
                    facts, steps = (("part", part), ("form", name)), round(args.steps / paces[name])
                    title = f"{part}-{name}-{args.steps}-{seed}"
                    runs.append(Trial(title, trial.words, steps, seed, 0, facts, interventions=None))
        run_all(runs, RECORD, KEYS, args.jobs, machine=f"one thread of {cpu_name()}", **found)
    text = quality_table(read_record(RECORD))
    if args.docs:
        between_markers(DOCS / "relighting.md", "relight-quality", text)


if __name__ == "__main__":
    main()
