"""What the factors on phases bring: settings of the model that change neither its bytes nor its time.

    python benchmarks/factors.py [--chair DIR] [--seeds 2] [--jobs 1] [--docs] [--print]

`model.density.omega0` on the chair, `model.colour.boost` on `lit_solids`, and `model.colour.frequencies` on
`smoke_fire` with the paper's dynamic form (`preset=equations`, whose colour has waves in time). All else is the scene's
preset, at a budget in steps; test views judge, and decide nothing. Results go to benchmarks/results/factors.json as
they come, and only what is missing is run; --docs puts the table between the markers of docs/tradeoffs.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, recorded, run_all

from neuprim.core.compute.machine import cpu_name

RESULTS = Path(__file__).parent / "results" / "factors.json"
SCENES: dict[str, tuple[tuple[str, ...], int, str]] = {
    "chair, 200×200": (("task=static", "scene=blender", "train.background=white"), 2500, "psnr"),
    "`smoke_fire`, 64×64, `preset=equations`": (
        ("task=dynamic", "scene=smoke_fire", "scene.size=64", "preset=equations"),
        2000,
        "psnr_mask",
    ),
    "`lit_solids`, 128×128": (("task=relight", "scene=lit_solids", "scene.size=128"), 1440, "psnr_linear_clamped"),
}
"""Scene -> words, steps, and the measure."""
CHAIR, SMOKE, LIT = SCENES
KNOBS = {
    CHAIR: ("model.density.omega0", (10, 30, 90)),
    SMOKE: ("model.colour.frequencies", ("printed", "periods")),
    LIT: ("model.colour.boost", (1, 3, 10)),
}


def trials(chair: Path, seeds: int) -> list[Trial]:
    made = []
    for scene, (words, steps, _) in SCENES.items():
        knob, values = KNOBS[scene]
        data = (f"scene.path='{chair.resolve()}'",) if scene == CHAIR else ()
        for value in values:
            facts = (("scene", scene), ("value", str(value)))
            made += [
                Trial(f"{knob}={value}-{seed}", (*words, *data, f"{knob}={value}"), steps, seed, facts=facts)
                for seed in range(seeds)
            ]
    return made


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    made = Table("scene", "setting", "steps", "PSNR")
    for scene, (_, steps, measure) in SCENES.items():
        knob, values = KNOBS[scene]
        for value in values:
            own = [row[measure] for row in rows if (row["scene"], row["value"]) == (scene, str(value))]
            if own:
                made.row(scene, f"`{knob}={value}`", f"{steps:,}", f"{spread(own, 2)} dB")
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if args.chair is None:
            parser.error("--chair: wants the folder of its data")
        measures = tuple(measure for *_, measure in SCENES.values())
        run_all(trials(args.chair, args.seeds), RESULTS, measures, args.jobs, str, {"cpu": cpu_name()})
    made = table(recorded(RESULTS))
    if args.docs:
        between_markers(ROOT / "docs" / "tradeoffs.md", "factors", str(made))


if __name__ == "__main__":
    main()
