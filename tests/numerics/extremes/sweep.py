"""Run regions through backends and say which bounds hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from neuprim.core.model.edge import EDGES
from neuprim.core.render.backends import REFERENCE
from tests import backends
from tests.numerics.extremes.measure import Errors, compare, integrals
from tests.numerics.extremes.regions import REGIONS, Region

BACKENDS = (*((name, "float32") for name in backends.BACKENDS), (REFERENCE, "float64"))


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


def measure(region: Region, edge: int, cases: int, left_out: Sequence[str] = ()) -> list[Result]:
    """Worst of the first ``cases`` cases, per backend but those ``left_out``. Gradients are compared on the fast ones;
    the reference's are the
    standard."""
    found = [
        Result(region, backend, precision, edge, Errors()) for backend, precision in BACKENDS if backend not in left_out
    ]
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
