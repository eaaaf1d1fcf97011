"""Run regions through backends and say which bounds hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from tests.numerics.extremes.measure import Errors, compare
from tests.numerics.extremes.regions import REGIONS, Region

__all__ = ["BACKENDS", "Result", "document", "measure", "sweep", "table"]

BACKENDS = (("cpu", "float32"), ("reference", "float32"), ("reference", "float64"))
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

    @property
    def label(self) -> str:
        return f"{self.region.name}, {self.backend} {self.precision}"

    @property
    def broken(self) -> list[str]:
        e, r = self.errors, self.region
        parts = (
            ("error/S", "forward", e.forward, r.forward),
            ("thin", "thin", e.thin, r.thin),
            ("gradient", "gradient", e.gradient, r.gradient),
        )
        texts = [
            f"{label} {found:.1e} > {bound:.0e} in {e.worst.get(key, '?')}" for label, key, found, bound in parts if not found <= bound
        ]
        return texts if e.hits else [*texts, "nothing was drawn"]

    def line(self) -> str:
        e, r = self.errors, self.region
        gradient = "" if self.backend == "reference" else f"{e.gradient:.1e} {e.parameter}"
        thin = "" if r.whole else f"{e.thin:.1e}"
        bounds = f"{r.forward:.0e}, {r.thin:.0e}, {r.gradient:.0e}" if not r.whole else f"{r.forward:.0e}, {r.gradient:.0e}"
        wide = f"{e.wide}/{e.primitives}" if self.backend == "cpu" else ""
        state = "**broken**" if self.broken else "ok"
        return f"| {r.name} | {self.backend} {self.precision} | {e.forward:.1e} | {thin} | {gradient} | {wide} | {bounds} | {state} |"


def measure(region: Region, backend: str, precision: str, cases: int) -> Result:
    """Worst of the first ``cases`` cases. Gradients are compared on the fast backends; the reference's are the standard."""
    worst = Errors()
    for number in range(cases):
        case = region.case(number)
        worst.absorb(compare(case, backend, precision, region.whole, backend != "reference"), case.name)
    return Result(region, backend, precision, worst)


def sweep(cases: int, names: Sequence[str] = ()) -> Iterator[Result]:
    """Every region whose name contains one of ``names`` (all if none) on every backend."""
    for region in REGIONS:
        if not names or any(n in region.name for n in names):
            for backend, precision in BACKENDS:
                yield measure(region, backend, precision, cases)


def table(results: Sequence[Result]) -> str:
    return "\n".join([*_HEADER, *(r.line() for r in results)])


def document(results: Sequence[Result]) -> str:
    return table(results) + "\n"
