"""Run regions through backends and say which bounds hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from neuprim.core.model.edge import EDGES
from neuprim.core.render.backends import REFERENCE
from tests import backends
from tests.numerics.extremes.measure import OPAQUE, RIM, SOLID, Errors, compare, integrals
from tests.numerics.extremes.regions import COLOUR, REGIONS, THIN, Region

__all__ = ["BACKENDS", "Result", "document", "line", "measure", "sweep", "table"]

BACKENDS = (*((name, "float32") for name in backends.BACKENDS), (REFERENCE, "float64"))
_HEADER = (
    "| region | backend | error/S | thin | gradient | drawn in float64 | bounds | |",
    "| --- | --- | --- | --- | --- | --- | --- | --- |",
)


@dataclass
class Result:
    """Worst errors of one region on one backend, for one edge."""

    region: Region
    backend: str
    precision: str
    edge: int
    errors: Errors

    @property
    def label(self) -> str:
        return f"{self.region.name}, edge {self.edge}, {self.backend} {self.precision}"

    @property
    def broken(self) -> list[str]:
        e, r = self.errors, self.region
        parts = (
            ("error/S", "forward", e.forward, r.forward),
            ("thin", "thin", e.thin, r.thin_at(self.edge)),
            ("gradient", "gradient", e.gradient, r.gradient_at(self.edge)),
        )
        texts = [
            f"{label} {found:.1e} > {bound:.1e} in {e.worst.get(key, '?')}"
            for label, key, found, bound in parts
            if not found <= bound
        ]
        return texts if e.hits else [*texts, "nothing was drawn"]


def measure(region: Region, edge: int, cases: int) -> list[Result]:
    """Worst of the first ``cases`` cases, per backend. Gradients are compared on the fast ones; the reference's are the
    standard."""
    found = [Result(region, backend, precision, edge, Errors()) for backend, precision in BACKENDS]
    for number in range(cases):
        case = region.case(number, edge)
        exact = None if region.whole else integrals(case)
        for result in found:
            result.errors.absorb(
                compare(case, result.backend, result.precision, region.whole, result.backend != REFERENCE, exact),
                case.name,
            )
    return found


def sweep(cases: int, names: Sequence[str] = (), edges: Sequence[int] = EDGES) -> Iterator[list[Result]]:
    """Every region whose name contains one of ``names`` (all if none): what each backend found for each edge that the
    region is for."""
    for region in REGIONS:
        if not names or any(n in region.name for n in names):
            columns = [measure(region, edge, cases) for edge in edges if edge in region.edges]
            yield from ([column[i] for column in columns] for i in range(len(BACKENDS) if columns else 0))


def line(row: Sequence[Result]) -> str:
    """One region on one backend, what was found for each edge side by side."""
    first, region = row[0], row[0].region

    def beside(cells: Sequence[str]) -> str:
        """The cells of all edges; a dash where the region is not for one that others are for."""
        found = dict(zip((r.edge for r in row), cells, strict=True))
        return (
            " / ".join(found.get(edge, "–") for edge in (EDGES if len(region.edges) < len(EDGES) else found))
            if any(cells)
            else ""
        )

    thin = "" if region.whole else beside([f"{r.errors.thin:.1e}" for r in row])
    gradient = "" if first.backend == REFERENCE else beside([f"{r.errors.gradient:.1e}" for r in row])
    wide = (
        beside([f"{r.errors.wide}" for r in row]) + f" of {first.errors.primitives}"
        if first.backend != REFERENCE
        else ""
    )
    bounds = [f"{region.forward:.0e}"]
    if not region.whole:
        bounds.append(_once([f"{region.thin_at(r.edge):.0e}" for r in row]))
    if first.backend != REFERENCE:
        bounds.append(_once([f"{region.gradient_at(r.edge):.0e}" for r in row]))
    state = "**broken**" if any(r.broken for r in row) else "ok"
    forward = beside([f"{r.errors.forward:.1e}" for r in row])
    return f"| {region.name} | {first.backend} {first.precision} | {forward} | {thin} | {gradient} | {wide} | {', '.join(bounds)} | {state} |"


def _once(texts: Sequence[str]) -> str:
    return texts[0] if len(set(texts)) == 1 else " / ".join(texts)


def table(rows: Sequence[Sequence[Result]]) -> str:
    return "\n".join([*_HEADER, *(line(row) for row in rows)])


_PAGE = """# Numerical limits

Made by `python benchmarks/numerics.py --markdown docs/numerical_limits.md`; the command exits non-zero when a bound is broken. Every
region draws random primitives and cameras with the proportions in its name; each row is the worst of {cases} cases of 24 x 24 pixels.
Numbers side by side are of edges p = 0 / 1 / 2: the same primitives and cameras, a hard edge and two soft ones ((1 - |y|^2)^p; a gain of its
own for each primitive in the region of gains). One bound for all three is written once. The oracle is the closed form in extended precision (numpy's longdouble, checked against fifty digits of another form); gradients are
compared with the float64 reference.

What is compared:

- **error/S**: error of a chord's optical depth over S = (N h/m)(|b2| + sum |w2|), N = 2, 4/3, 16/15, on chords at least {solid} as long as
  the one through the centre; the error of alpha itself where the depth exceeds {opaque}. For several primitives, the largest error of a pixel.
- **thin**: on shorter chords, misses included, error/S_c x (S_c/S)^(2p - 1), with S_c of the chord through the centre (S/S_c counts as 0.01 where it
  is less and p > 0).
- **gradient**: error of a parameter's gradient over its norm, over four random functionals of the image.
- **colour network**: the density is everyday; in place of its integral the colour is compared, over |base| + sum |Wout|, with the network
  in extended precision at the middle of the chord, on solid chords ("error/S") and on the others ("thin", without a factor). Radians
  are what the fastest unit turns over a length of 2 m.
- **drawn in float64**: primitives whose pixels a fast backend computes in float64, because float32 could not follow.

## Where the usual bounds do not hold

- **Thin chords, float32.** With l = S/S_c, the chord's length over that of the one through the centre, D = 1 - |x_m|^2 is l^2: a difference of
  numbers near one, which float32 knows to about 1e-7. The integral goes as D^(p + 1/2), so its error over S_c is (p + 1/2) l^(2p - 1) dD. A hard
  edge's grows on thin chords, as 1/l: error/S <= 1e-6 needs D of 0.2 or more, below the bound on error/S_c is {thin:.0e}/l; it is never above
  {root:.0e}, that of a rim pixel on the wrong side of the silhouette. A soft edge's shrinks: the bounds are {thin1:.1e} l for p = 1 and
  {thin2:.0e} l^3 for p = 2. The near plane leaves short chords of the same kind. The reference backend has no such limit.
- **Silhouettes, backward.** dI/dD grows as D^-1/2 with a hard edge: every backend takes max(D, `renderer.depth_floor`) there, and pixels with
  |D| < {rim:.0e} are left out of the comparison, as float32 may not know whether they meet the primitive. With a soft edge it goes as
  D^(p - 1/2), to nothing: there is no floor, no pixel is left out, and in "on the silhouette" one has |D| < 1e-12. What float32 does not
  know about that pixel's D is up to sqrt({thin:.0e}) = 6e-4 of a derivative at p = 1, beside some 0.1 on the other pixels of such a view.
- **Gains.** Beyond |log g| = 20 a gain counts as e^20 or e^-20, forward, and its gradient is zero; up to there it costs a rounding or two.
- **Fast colour networks, float32.** A unit of up to 4 turns over half a chord is drawn in float32, which knows its phase to about
  3e-6 radians; nothing like the sinc of the density's integral damps it. From 30 rad over 2 m on the bound is {colour:.0e}.
- **Cuts.** A pixel whose alpha lies within 1e-6 of alpha_min, or whose transmittance lies within a thousandth of
  transmittance_min, may fall on either side; such pixels are left out.
- **Far needles, float64.** The camera-space centre R mu + t is itself rounded at 1e-16 of its distance, so at distance/radius 1e5 and
  axis ratio 1e4 even the float64 reference knows D to about 1e-7 only; a phase that turns w radians per m likewise to about
  1e-16 x w x distance/radius.

- **Near planes inside a scene.** From 1.5 m in front of the camera on a primitive is anchored at its own centre, wherever the near plane
  lies. Of a trained chair's 2,000 primitives with a hard edge, 4 units from the camera, 12 a view are drawn in float64 with the near plane at 0.01 and 5
  with it at 4, through the chair; did anchors keep 1.5 m from that plane, too, it would be 411. Soft edges that are cut are drawn in float64 either way.
  No image of either is off by more than 5e-7 (`python benchmarks/numerics.py --run RUN_DIR --near 0.01 3 3.5 4`).

## Worst errors

{table}
"""


def document(rows: Sequence[Sequence[Result]], cases: int) -> str:
    """The documentation page."""
    numbers = {
        "cases": cases,
        "solid": SOLID,
        "opaque": OPAQUE,
        "rim": RIM,
        "thin": THIN,
        "thin1": 3 * THIN,
        "thin2": 5 * THIN,
        "root": THIN**0.5,
        "colour": COLOUR,
    }
    return _PAGE.format(table=table(rows), **numbers)
