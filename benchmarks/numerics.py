"""Worst errors of every backend over the named extremes of the input space, for the three edges.

    python benchmarks/numerics.py [--coarse] [--cases N] [--regions NAME ...] [--edges 0 1 2] [--record]
    python benchmarks/numerics.py --print [--docs]
    python benchmarks/numerics.py --run RUN_DIR [--near 0.01 3 3.5 4]

Prints one line per region, backend and precision, with the edges' numbers side by side; exits with status 1 when a
bound is broken. A backend and precision is "cpu float32", "reference float32" (float32 parameters, float64 inside) or
"reference float64". The oracle runs in extended precision and shares no code with the backends; gradients are compared
with the float64 reference's.

- error/S: of the optical depth of a chord, S = (N_p h/m)(|b2| + sum |w2|), N = 2, 4/3, 16/15, on chords of at least
  0.45 of the central one.
- thin: on shorter chords, misses included, error/S_c (S_c/S)^(2p - 1), S_c the central chord's S.
- gradient: error of a parameter's gradient over the gradient's norm, over four random functionals of the image.

--record writes a row per region, backend, precision and edge to docs/results/numerics.csv, and makes
docs/pictures/numerics.png and the worst values in docs/results/numerics.md from them; --print --docs makes these two
from the recorded file. --run looks at a trained model instead: from a dozen of its held-out views, with the near plane
at each of --near, how many primitives the cpu backend draws in float64, and the largest error of three small images
against the reference backend.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from shared.arguments import make_parser
from shared.tables import DOCS, RESULT_PAGES, Table, between_markers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neuprim.core.model.edge import EDGES
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.backends import REFERENCE
from neuprim.runs.open import load_dataset, load_run
from tests.numerics.extremes.sweep import Result, sweep

RECORD, PICTURE = RESULT_PAGES / "numerics.csv", DOCS / "pictures" / "numerics.png"
QUANTITIES = {"error": "error/S", "thin": "thin chords", "gradient": "gradient"}
"""Column of the record -> what it is called. Each has a column with its bound, "bound_" before its name."""
DRAWN = {("cpu", "float32"): "C0", ("reference", "float64"): "C1"}
"""Backends and precisions in the picture, and their colours."""
LEAST = 1e-17  # where errors of 0 are drawn
VIEWS, COMPARED, SMALL = 12, 3, 50  # of a run: views to count in, how many of them to compare, and those images' sides


@torch.no_grad()
def measure_run(folder: Path, near: float) -> str:
    """What float64 is needed for in a finished run's model with this near plane, in one line."""
    stored = load_run(folder)
    model = stored.model
    dataset = load_dataset(stored)
    settings = [
        RenderSettings(backend=backend, near=near, alpha_min=0.0, transmittance_min=0.0)
        for backend in ("cpu", "reference")
    ]
    counts, worst = [], 0.0
    for i in sorted({i * len(dataset.test) // VIEWS for i in range(VIEWS)}):
        view = dataset.test.view(i)
        frame = render(model, view.camera, view.conditions, settings[0], dataset.background)
        counts.append(int(frame.stats.extra["float64"]))
        if len(counts) <= COMPARED:
            small = view.camera.resized(SMALL, SMALL)
            fast, slow = (render(model, small, view.conditions, s, dataset.background).rgb for s in settings)
            worst = max(worst, (fast - slow).abs().max().item())
    return (
        f"near {near:g}: {sum(counts) / len(counts):.1f} of {model.count} primitives in float64 ({min(counts)} to "
        f"{max(counts)} a view), largest error {worst:.1e}"
    )


def cells(row: Sequence[Result]) -> list[str]:
    """One region on one backend, what was found for each edge side by side; a dash where the region has no edge."""
    region, backend = row[0].region, row[0].backend

    def beside(numbers: Sequence[str]) -> str:
        found = dict(zip((r.edge for r in row), numbers, strict=True))
        return " / ".join(found.get(edge, "–") for edge in (EDGES if len(region.edges) < len(EDGES) else found))

    def once(texts: Sequence[str]) -> str:
        return texts[0] if len(set(texts)) == 1 else " / ".join(texts)

    thin = gradient = wide = ""
    bounds = [f"{region.forward:.0e}"]
    if not region.whole:
        thin = beside([f"{r.errors.thin:.1e}" for r in row])
        bounds.append(once([f"{region.thin_at(r.edge):.0e}" for r in row]))
    if backend != REFERENCE:
        gradient = beside([f"{r.errors.gradient:.1e}" for r in row])
        wide = beside([f"{r.errors.wide}" for r in row]) + f" of {row[0].errors.primitives}"
        bounds.append(once([f"{region.gradient_at(r.edge):.0e}" for r in row]))
    state = "**broken**" if any(r.broken for r in row) else "ok"
    forward = beside([f"{r.errors.forward:.1e}" for r in row])
    return [region.name, f"{backend} {row[0].precision}", forward, thin, gradient, wide, ", ".join(bounds), state]


def record_row(result: Result) -> dict[str, object]:
    """What the record says of one region on one backend, for one edge; "" for what is not compared."""
    region, errors, fast = result.region, result.errors, result.backend != REFERENCE
    return {
        "region": region.name,
        "backend": result.backend,
        "precision": result.precision,
        "edge": result.edge,
        "error": f"{errors.forward:.1e}",
        "thin": "" if region.whole else f"{errors.thin:.1e}",
        "gradient": f"{errors.gradient:.1e}" if fast else "",
        "float64": errors.wide if fast else "",
        "primitives": errors.primitives if fast else "",
        "bound_error": f"{region.forward:.0e}",
        "bound_thin": "" if region.whole else f"{region.thin_at(result.edge):.0e}",
        "bound_gradient": f"{region.gradient_at(result.edge):.0e}" if fast else "",
    }


def read_rows() -> list[dict[str, str]]:
    """The recorded rows."""
    with RECORD.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def describe(rows: Sequence[Mapping[str, str]]) -> str:
    """The worst values of each backend and precision, as a list."""
    broken = [row for row in rows for key in QUANTITIES if row[key] and float(row[key]) > float(row[f"bound_{key}"])]
    regions = len({row["region"] for row in rows})
    kept = f"{len(broken)} of them exceed their bounds" if broken else "All of them are within their bounds"
    texts = [f"The record has {len(rows)} rows for {regions} regions. {kept}. The largest errors:\n"]
    for backend, precision in dict.fromkeys((row["backend"], row["precision"]) for row in rows):
        own = [row for row in rows if (row["backend"], row["precision"]) == (backend, precision)]
        worst = []
        for key, name in QUANTITIES.items():
            if known := [row for row in own if row[key]]:
                row = max(known, key=lambda row: float(row[key]))
                place = f"{row['region']}, p = {row['edge']}"
                worst.append(f"{name} {row[key]} (bound {row[f'bound_{key}']}; {place})")
        texts.append(f"* {backend} backend, {precision}: {'; '.join(worst)}")
    return "\n".join(texts)


def draw_picture(rows: Sequence[Mapping[str, str]]) -> None:
    """A line per region and a panel per quantity: the errors of DRAWN, and the bound of each."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 7, "axes.spines.top": False, "axes.spines.right": False})
    places = {name: i for i, name in enumerate(dict.fromkeys(row["region"] for row in rows))}
    figure, panels = plt.subplots(1, len(QUANTITIES), figsize=(9, 11), sharey=True, layout="constrained")
    for axes, (key, name) in zip(panels, QUANTITIES.items(), strict=True):
        known = [row for row in rows if row[key]]
        for (backend, precision), colour in DRAWN.items():
            own = [row for row in known if (row["backend"], row["precision"]) == (backend, precision)]
            errors, lines = [max(float(row[key]), LEAST) for row in own], [places[row["region"]] for row in own]
            axes.plot(errors, lines, ".", color=colour, ms=5, alpha=0.7, label=f"{backend}, {precision}")
        bounds = [float(row[f"bound_{key}"]) for row in known]
        axes.plot(bounds, [places[row["region"]] for row in known], "|", color="black", ms=6, label="bound")
        axes.set(xscale="log", title=name, ylim=(len(places) - 0.5, -0.5), yticks=range(len(places)))
        axes.grid(axis="y", color="0.92", lw=0.5)
        axes.set_axisbelow(True)
    panels[0].set_yticklabels(places)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(PICTURE, dpi=110)


def show_record() -> None:
    """Write the paragraph and the picture."""
    rows = read_rows()
    between_markers(RESULT_PAGES / "numerics.md", "limits", describe(rows))
    draw_picture(rows)


def main() -> int:
    parser = make_parser(__doc__, "--record", "--docs", "--print")
    parser.add_argument("--coarse", action="store_true", help="3 cases per region instead of 40")
    parser.add_argument("--cases", type=int, help="cases per region")
    parser.add_argument("--regions", nargs="*", default=[], help="only regions whose name contains one of these")
    parser.add_argument("--edges", nargs="*", type=int, choices=EDGES, default=EDGES)
    parser.add_argument("--run", type=Path, help="a finished run's directory, instead of the regions")
    parser.add_argument("--near", nargs="*", type=float, default=[0.01], help="of --run: near planes, scene units")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.run:
        for near in args.near:
            print(measure_run(args.run, near))
        return 0
    if args.only_print:
        print(describe(read_rows()))
        if args.docs:
            show_record()
        return 0
    rows = []
    table = Table("region", "backend", "error/S", "thin", "gradient", "drawn in float64", "bounds", "")
    for row in sweep(args.cases or (3 if args.coarse else 40), args.regions, args.edges):
        table.row(*cells(row))
        rows.append(row)
    if not rows:
        print(f"no region contains {args.regions}", file=sys.stderr)
        return 2
    if args.record:
        recorded = [record_row(result) for row in rows for result in row]
        with RECORD.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(recorded[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(recorded)
        show_record()
    broken = [result for row in rows for result in row if result.broken]
    for result in broken:
        print(f"broken: {result.label}: {', '.join(result.broken)}", file=sys.stderr)
    print(f"{len(rows)} rows, {len(broken)} results broken")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
