"""Run regions through backends and say which bounds hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from neuprim.core.render.backends import ORACLE, available
from tests.numerics.extremes.measure import OPAQUE, RIM, SOLID, Errors, compare
from tests.numerics.extremes.regions import COLOUR, REGIONS, THIN, Region

__all__ = ["BACKENDS", "Result", "document", "measure", "sweep", "table"]

BACKENDS = (*((backend.name, "float32") for backend in available()), (ORACLE, "float64"))
_HEADER = (
    "| region | backend | error/S | thin | gradient | drawn in float64 | bounds | |",
    "| --- | --- | --- | --- | --- | --- | --- | --- |",
)


@dataclass
class Result:
    """Worst errors of one region on one backend."""

    region: Region
    backend: str
    precision: str
    errors: Errors
    edge: int = 0

    @property
    def label(self) -> str:
        return f"{self.region.name}, edge {self.edge}, {self.backend} {self.precision}"

    @property
    def thin(self) -> float:
        """The region's bound; an integral that goes as D^(p + 1/2) is 2p + 1 times as sensitive to D."""
        return self.region.thin * (2 * self.edge + 1) if not self.region.name.startswith("colour network") else self.region.thin

    @property
    def gradient(self) -> float:
        """The region's bound; where only a rim lets light through, it is all that there is to differentiate."""
        return self.region.gradient * (2 * self.edge + 1) if self.region.name == "huge densities" else self.region.gradient

    @property
    def broken(self) -> list[str]:
        e, r = self.errors, self.region
        parts = (
            ("error/S", "forward", e.forward, r.forward),
            ("thin", "thin", e.thin, self.thin),
            ("gradient", "gradient", e.gradient, self.gradient),
        )
        texts = [
            f"{label} {found:.1e} > {bound:.0e} in {e.worst.get(key, '?')}" for label, key, found, bound in parts if not found <= bound
        ]
        return texts if e.hits else [*texts, "nothing was drawn"]

    def line(self) -> str:
        e, r = self.errors, self.region
        gradient = "" if self.backend == ORACLE else f"{e.gradient:.1e} {e.parameter}"
        thin = "" if r.whole else f"{e.thin:.1e}"
        bounds = f"{r.forward:.0e}, {self.thin:.0e}, {self.gradient:.0e}" if not r.whole else f"{r.forward:.0e}, {self.gradient:.0e}"
        wide = f"{e.wide}/{e.primitives}" if self.backend == "cpu" else ""
        state = "**broken**" if self.broken else "ok"
        return f"| {r.name} | {self.backend} {self.precision} | {e.forward:.1e} | {thin} | {gradient} | {wide} | {bounds} | {state} |"


def measure(region: Region, backend: str, precision: str, cases: int, edge: int = 0) -> Result:
    """Worst of the first ``cases`` cases. Gradients are compared on the fast backends; the reference's are the standard."""
    worst = Errors()
    for number in range(cases):
        case = replace(region.case(number), edge=edge)
        worst.absorb(compare(case, backend, precision, region.whole, backend != ORACLE), case.name)
    return Result(region, backend, precision, worst, edge)


def sweep(cases: int, names: Sequence[str] = ()) -> Iterator[Result]:
    """Every region whose name contains one of ``names`` (all if none) on every backend."""
    for region in REGIONS:
        if not names or any(n in region.name for n in names):
            for backend, precision in BACKENDS:
                yield measure(region, backend, precision, cases)


def table(results: Sequence[Result]) -> str:
    return "\n".join([*_HEADER, *(r.line() for r in results)])


_PAGE = """# Numerical limits

Made by `python benchmarks/numerics.py --markdown docs/numerical_limits.md`; the command exits non-zero when a bound is broken. Every
region draws random primitives and cameras with the proportions in its name; each row is the worst of {cases} cases of 24 x 24 pixels.
The oracle is the closed form in extended precision (numpy's longdouble, checked against fifty digits of another form); gradients are
compared with the float64 reference.

What is compared:

- **error/S**: error of a chord's optical depth over S = (2h/m)(|b2| + sum |w2|), on chords at least {solid} as long as the one through
  the centre; the error of alpha itself where the depth exceeds {opaque}. For several primitives, the largest error of a pixel.
- **thin**: on shorter chords, misses included, error/S x (S/S_c)^2, with S_c of the chord through the centre.
- **gradient**: error of a parameter's gradient over its norm, over four random functionals of the image.
- **colour network**: the density is everyday; in place of its integral the colour is compared, over |base| + sum |Wout|, with the network
  in extended precision at the middle of the chord, on solid chords ("error/S") and on the others ("thin", without a factor). Radians
  are what the fastest unit turns over a length of 2 m.
- **drawn in float64**: primitives whose pixels the cpu backend computes in float64, because float32 could not follow.

## Where the usual bounds do not hold

- **Thin chords, float32.** D = 1 - |x_m|^2 is a difference of numbers near one, which float32 knows to about 1e-7, and h = sqrt(D/a)
  turns that into error/S = dD/2D. So error/S <= 1e-6 needs D of 0.2 or more; below, the bound is {thin:.0e} (S_c/S)^2. Against the chord
  through the centre the error is never above {root:.0e}: that of a rim pixel on the wrong side of the silhouette. The near plane leaves
  short chords of the same kind. The reference backend has no such limit.
- **Silhouettes, backward.** dh/dD grows as D^-1/2. Every backend takes max(D, `renderer.depth_floor`) there. Pixels with |D| < {rim:.0e}
  are left out of the comparison: float32 may not know whether they meet the primitive.
- **Fast colour networks, float32.** A unit of up to 4 turns over half a chord is drawn in float32, which knows its phase to about
  3e-6 radians; nothing like the sinc of the density's integral damps it. From 30 rad over 2 m on the bound is {colour:.0e}.
- **Cuts.** A pixel whose alpha lies within 1e-6 of alpha_min, or whose transmittance lies within a thousandth of
  transmittance_min, may fall on either side; such pixels are left out.
- **Far needles, float64.** The camera-space centre R mu + t is itself rounded at 1e-16 of its distance, so at distance/radius 1e5 and
  axis ratio 1e4 even the float64 reference knows D to about 1e-7 only; a phase that turns w radians per m likewise to about
  1e-16 x w x distance/radius.

## Worst errors

{table}
"""


def document(results: Sequence[Result], cases: int) -> str:
    """The documentation page."""
    numbers = {"cases": cases, "solid": SOLID, "opaque": OPAQUE, "rim": RIM, "thin": THIN, "root": THIN**0.5, "colour": COLOUR}
    return _PAGE.format(table=table(results), **numbers)
