# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""How much of an ellipsoid can be seen, on the device: the twin of :mod:`neuprim.core.render.cpu.seen` and of
``_longest`` in ``prepare``."""

from neuprim.core.compute.warp import wp
from neuprim.core.model.edge import NORMS
from neuprim.core.render.cpu.seen import POWERS, WORTHS
from neuprim.core.render.cuda.placement import Placed, Ray, View, rounded

__all__ = ["longest", "seen_square", "too_faint"]

d = wp.float64
(_N0, _N1, _N2), (_P0, _P1, _P2), (_W0, _W1, _W2) = (
    [wp.constant(d(number)) for number in numbers] for numbers in (NORMS, POWERS, WORTHS)
)


@wp.func
def longest(p: Placed, r: Ray, v: View, reach: wp.float64):
    """A bound of the half chords of all rays that meet the ellipsoid, in units of its longest semi-axis; ``reach`` of
    it along the view."""
    bound, one = d(1.0), d(1.0)
    if r.tc != d(0.0):
        z = p.centre[2]
        slope_x, slope_y, wide = wp.abs(p.centre[0] / z), wp.abs(p.centre[1] / z), p.m / (z - reach)
        du, dv = wide * (one + slope_x), wide * (one + slope_y)
        least = (
            wp.sqrt(wp.dot(r.e0, r.e0))
            - v.focal[0] * du * wp.sqrt(wp.dot(r.ex, r.ex))
            - v.focal[1] * dv * wp.sqrt(wp.dot(r.ey, r.ey))
        )
        most = wp.sqrt(one + (slope_x + du) * (slope_x + du) + (slope_y + dv) * (slope_y + dv))
        if least > most:
            bound = most / least
    return bound


@wp.func
def _of(edge: int, hard: wp.float64, one: wp.float64, two: wp.float64):
    """An array would be a stack: its index is not known to the compiler."""
    number = hard
    if edge == 1:
        number = one
    if edge == 2:
        number = two
    return number


@wp.func
def too_faint(most: wp.float64, edge: int, least: wp.float64):
    """Whether no chord can reach the depth ``least``, however long."""
    return most <= d(0.0) or most * _of(edge, _N0, _N1, _N2) <= least


@wp.func
def seen_square(most: wp.float64, bound: wp.float64, edge: int, least: wp.float64):
    """r^2 of the part that can be seen: 1 for all of it, 0 for nothing. ``most``: b2 + sum |w2|, positive; ``bound``:
    from :func:`longest`."""
    square, share = d(0.0), least / (most * _of(edge, _N0, _N1, _N2) * bound)
    if share <= _of(edge, _W0, _W1, _W2):
        square = d(1.0)
    elif share < d(1.0):
        square = rounded(d(1.0) - wp.exp(wp.log(share) * _of(edge, _P0, _P1, _P2)))
    return square
