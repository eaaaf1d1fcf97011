"""Worst errors of every backend over the named extremes of the input space, for the three edges.

    python benchmarks/numerics.py [--coarse] [--cases N] [--regions NAME ...] [--edges 0 1 2] [--record]
    python benchmarks/numerics.py --run RUN_DIR [--near 0.01 3 3.5 4]

Prints one line per region, backend and precision, with the edges' numbers side by side; exits with status 1 when a
bound is broken. A backend and precision is "cpu float32", "reference float32" (float32 parameters, float64 inside) or
"reference float64". The oracle runs in extended precision and shares no code with the backends; gradients are compared
with the float64 reference's.

- error/S: of the optical depth of a chord, S = (N_p h/m)(|b2| + sum |w2|), N = 2, 4/3, 16/15, on chords of at least
  0.45 of the central one.
- thin: on shorter chords, misses included, error/S_c (S_c/S)^(2p - 1), S_c the central chord's S.
- gradient: error of a parameter's gradient over the gradient's norm, over four random functionals of the image.

--record writes the table to docs/numerical_limits.md. --run looks at a trained model instead: from a dozen of its
held-out views, with the near plane at each of --near, how many primitives the cpu backend draws in float64, and the
largest error of three small images against the reference backend.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from shared.arguments import make_parser
from shared.tables import DOCS, Table, between_markers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from neuprim.core.model.edge import EDGES
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.backends import REFERENCE
from neuprim.runs.open import load_dataset, load_run
from tests.numerics.extremes.sweep import Result, sweep

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


def main() -> int:
    parser = make_parser(__doc__, "--record")
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
    rows = []
    table = Table("region", "backend", "error/S", "thin", "gradient", "drawn in float64", "bounds", "")
    for row in sweep(args.cases or (3 if args.coarse else 40), args.regions, args.edges):
        table.row(*cells(row))
        rows.append(row)
    if not rows:
        print(f"no region contains {args.regions}", file=sys.stderr)
        return 2
    if args.record:
        between_markers(DOCS / "numerical_limits.md", "limits", str(table))
    broken = [result for row in rows for result in row if result.broken]
    for result in broken:
        print(f"broken: {result.label}: {', '.join(result.broken)}", file=sys.stderr)
    print(f"{len(rows)} rows, {len(broken)} results broken")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
