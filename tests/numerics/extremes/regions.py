"""The named regions: what each varies, and the bounds it must keep."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from neuprim.core.model.edge import EDGES
from tests.numerics.extremes.draw import (
    amplified,
    crowd,
    cut,
    grazing,
    log_uniform,
    networked,
    signed,
    silhouette,
    single,
)
from tests.numerics.extremes.measure import Case

FORWARD, GRADIENT, THIN = 1e-6, 1e-3, 4e-7
COLOUR = 4e-6  # of a network's colour, at the fastest units that float32 draws
IMAGE = 5e-6  # of a pixel under tens of primitives, whose errors add up


@dataclass(frozen=True)
class Region:
    """A part of the input space."""

    name: str
    make: Callable[[np.random.Generator], Case]  # draws one case
    # bounds (see Errors)
    forward: float = FORWARD
    gradient: float = GRADIENT
    thin: float = THIN
    reason: str = ""  # why a bound is wider than the usual one; empty where none is
    whole: bool = False  # cases have several primitives: their images are compared, not single integrals
    edges: tuple[int, ...] = EDGES  # the exponents p that it is for

    def case(self, number: int, edge: int = 0) -> Case:
        """Case ``number`` of this region; the same on every machine, and for every edge."""
        case = self.make(np.random.default_rng([zlib.crc32(self.name.encode()), number]))
        return replace(case, name=f"{self.name} #{number}", edge=edge)

    def thin_at(self, edge: int) -> float:
        """The bound ``thin`` for an edge: an integral that goes as D^(p + 1/2) is 2p + 1 times as sensitive to D."""
        return self.thin if self.whole or self.name.startswith("colour network") else self.thin * (2 * edge + 1)

    def gradient_at(self, edge: int) -> float:
        """The bound ``gradient`` for an edge.

        Where only a rim lets light through, it is all that there is to differentiate. What float32 does not know about
        D, 4e-7, is sqrt(4e-7) = 6e-4 of dI/dD on the rim itself at p = 1, beside 0.1 on the rim's other pixels; at p =
        2 next to nothing.
        """
        if self.name == "huge densities":
            return self.gradient * (2 * edge + 1)
        return 6 * self.gradient if self.name == "on the silhouette" and edge == 1 else self.gradient


def _distances() -> list[Region]:
    out = []
    for d in (1e-2, 1e-1, 0.5, 1.0, 2.0, 10.0, 1e2, 1e3, 1e4, 1e5):
        fov = 90.0 if d < 1 else None
        out.append(Region(f"distance/radius {d:g}", lambda r, d=d, fov=fov: single(r, distance=(d, d), fov=fov)))  # type: ignore[misc]
    return out


def _rates() -> list[Region]:
    values = (0.0, 1e-12, 1e-6, 1e-3, 1.0, 10.0, 1e2, 1e3, 2e3)
    regions = [
        Region(f"phase rate {v:g} rad per chord", lambda r, v=v: single(r, rate=v, neurons=int(r.choice([1, 8]))))
        for v in values
    ]  # type: ignore[misc]
    return [
        *regions,
        Region("phase rates where series end", lambda r: single(r, rate=_seam(r), neurons=int(r.choice([1, 8])))),
    ]


def _seam(rng: np.random.Generator) -> float:
    """Twice a z at which some backend changes from a series or a polynomial of B_p to another form, less or more by a
    millionth."""
    return float(2 * rng.choice([1e-3, 2.0, np.pi, 3 * np.pi]) * (1 + 1e-6 * rng.choice([-1, 1])))


def _ratios() -> list[Region]:
    out = []
    for q in (1.0, 1e1, 1e2, 1e3, 1e4):
        for kind in ("needle", "disc") if q > 1 else ("any",):
            out.append(
                Region(
                    f"axis ratio {q:g}, {kind}",
                    lambda r, q=q, kind=kind: single(
                        r, ratio=(q, q), kind=kind, pixels=(0.3, 12.0), distance=(1.5, 20.0)
                    ),  # type: ignore[misc]
                )
            )
    return out


def _networks() -> list[Region]:
    """Colours that vary within a primitive; the density's rates stay everyday."""
    cases: dict[str, tuple[dict[str, object], tuple[float, float] | float]] = {
        "everyday": ({}, (0.5, 10.0)),
        "distance/radius 0.1": ({"distance": (0.1, 0.1), "fov": 90.0}, (0.5, 10.0)),
        "distance/radius 1000": ({"distance": (1e3, 1e3)}, (0.5, 10.0)),
        "distance/radius 100000": ({"distance": (1e5, 1e5)}, (0.5, 10.0)),
        "0 rad": ({}, 0.0),
        "30 rad": ({}, 30.0),
        "50 rad": ({}, 50.0),
        "100 rad": ({}, 100.0),
        "1000 rad": ({}, 1000.0),
        "needles": ({"ratio": (10.0, 1e4), "kind": "needle", "pixels": (0.3, 12.0)}, (0.5, 10.0)),
        "discs": ({"ratio": (10.0, 1e4), "kind": "disc", "pixels": (0.3, 12.0)}, (0.5, 10.0)),
        "needles and discs, far, 100 rad": (
            {"ratio": (1e2, 1e4), "distance": (1e2, 1e5), "pixels": (0.3, 12.0)},
            100.0,
        ),
        "near plane through the chord": ({"distance": (0.02, 1.0), "ratio": (1.2, 20.0), "fov": 80.0}, (0.5, 10.0)),
        "scales 1e-20": ({"scale": 1e-20}, (0.5, 10.0)),
        "scales 1e20": ({"scale": 1e20}, (0.5, 10.0)),
    }
    out = []
    for name, (more, rate) in cases.items():
        fast = isinstance(rate, float) and rate >= 30.0
        out.append(
            Region(
                f"colour network, {name}",
                lambda r, more=more, rate=rate: networked(r, single(r, **more), rate),  # type: ignore[misc, arg-type]
                forward=COLOUR if fast else FORWARD,
                thin=COLOUR if fast else FORWARD,
                reason="float32 draws units of up to 4 turns over half a chord, whose phase it knows to 3e-6 rad"
                if fast
                else "",
            )
        )
    return out


REGIONS: tuple[Region, ...] = (
    Region("everyday", lambda r: single(r)),
    *_distances(),
    *_rates(),
    *_ratios(),
    Region("needles and discs, far", lambda r: single(r, ratio=(1e2, 1e4), distance=(1e2, 1e5), pixels=(0.3, 12.0))),
    Region(
        "needles and discs, inside or near",
        lambda r: single(r, ratio=(1e2, 1e4), distance=(1e-2, 1.5), pixels=(0.01, 12.0)),
    ),
    Region(
        "needles and discs, fast neurons", lambda r: single(r, ratio=(10.0, 1e3), rate=(10.0, 1e3), pixels=(0.3, 12.0))
    ),
    Region("sub-pixel", lambda r: single(r, distance=(5.0, 1e4), pixels=(1e-3, 0.5), minimum=1)),
    Region("screen-filling", lambda r: single(r, distance=(1.2, 3.0), pixels=(30.0, 1e4))),
    Region("field of view 120", lambda r: single(r, distance=(0.5, 4.0), fov=120.0, minimum=2)),
    Region("field of view 160", lambda r: single(r, distance=(0.5, 4.0), fov=160.0, minimum=1)),
    Region("principal point at the border", lambda r: single(r, off=0.5)),
    Region("principal point far outside", lambda r: single(r, off=log_uniform(r, 2.0, 500.0))),
    Region("near plane through the chord", lambda r: single(r, distance=(0.02, 1.0), ratio=(1.2, 20.0), fov=80.0)),
    Region("faint", lambda r: single(r, depth=1e-6)),
    Region("scales 1e-20", lambda r: single(r, scale=1e-20)),
    Region("scales 1e-8", lambda r: single(r, scale=1e-8)),
    Region("scales 1e8", lambda r: single(r, scale=1e8)),
    Region("scales 1e20", lambda r: single(r, scale=1e20)),
    Region("far from the scene's origin", lambda r: single(r, mean=1e4)),
    Region("grazing", grazing),
    Region("on the silhouette", silhouette, edges=(1, 2)),
    Region("gains of e^-80 to e^80", lambda r: amplified(r, single(r))),
    Region("negative densities", signed),
    Region("dense", lambda r: single(r, depth=log_uniform(r, 5.0, 50.0))),
    Region("huge densities", lambda r: single(r, depth=log_uniform(r, 1e3, 1e30))),
    Region("alpha at alpha_min", lambda r: cut(r, alpha_min=0.3)),
    Region("alpha at alpha_max", lambda r: cut(r, alpha_max=0.4)),
    Region(
        "transmittance at its cut",
        lambda r: crowd(r, 30, transmittance_min=1e-4, alpha_min=1 / 255, alpha_max=0.99),
        forward=IMAGE,
        whole=True,
    ),
    Region("equal depths", lambda r: crowd(r, 8, equal=True), forward=IMAGE, whole=True),
    Region("crowd", lambda r: crowd(r, 60, alpha_min=1 / 255, transmittance_min=1e-4), forward=IMAGE, whole=True),
    *_networks(),
    Region(
        "colour network, crowd",
        lambda r: networked(r, crowd(r, 30, alpha_min=1 / 255, transmittance_min=1e-4)),
        forward=IMAGE,
        whole=True,
    ),
    Region("everything at once", lambda r: single(r, (0.02, 1e5), (1.2, 1e4), rate=(0.1, 1e2), pixels=(0.1, 30.0))),
)
