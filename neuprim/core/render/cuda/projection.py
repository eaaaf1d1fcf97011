# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Project a primitive into a camera view, in float64: the geometry of :mod:`neuprim.core.render.cpu.prepare`."""

from neuprim.core.compute.warp import OPTIONS, Doubles, wp
from neuprim.core.render.layout import ANCHOR_RADII

EXACT = {**OPTIONS, "fuse_fp": False}
"""Options of the per-primitive kernels. Every product is rounded (no fused multiply-add), so that kernels that count
the same tiles agree with each other and with the CPU."""

PER_BLOCK = 64
"""Threads per block, one per primitive. A float64 thread takes 163 registers, so that small blocks fill a
multiprocessor better than large blocks."""

d = wp.float64
_ANCHOR_RADII = wp.constant(d(ANCHOR_RADII))


@wp.struct
class View:
    """A camera: world-to-camera rotation R and translation t, focal lengths, principal point (pixels), near plane."""

    R: wp.mat33d
    t: wp.vec3d
    focal: wp.vec2d
    centre: wp.vec2d
    near: wp.float64


@wp.struct
class ProjectedPrimitive:
    """An ellipsoid in a view: orientation, semi-axes, centre, and anchor pixel.

    The columns of ``B`` and ``local`` are the directions of the ellipsoid's axes, in camera and in scene axes. ``m`` is
    the longest semi-axis, ``axes`` has all semi-axes / m. ``centre`` is in camera axes, scene units. ``anchor``
    (depth, x, y) is the depth of the centre and the pixel that shows the centre, but see :func:`project_primitive` for
    primitives near or behind the camera. ``inverse`` is 1/|quaternion|.
    """

    B: wp.mat33d
    local: wp.mat33d
    axes: wp.vec3d
    centre: wp.vec3d
    anchor: wp.vec3d
    m: wp.float64
    inverse: wp.float64


@wp.struct
class Ray:
    """The rays of all pixels through a primitive, in whitened space, where the ellipsoid is the unit sphere.

    For pixel offset (du, dv) from the anchor, let G = du ex + dv ey and s = du tu + dv tv. The ray is x(t) =
    (xa + du xu + dv xv + s G) + t (e0 + G), with xu = tc ex + tu e0 and xv = tc ey + tv e0. t is in units of the
    longest semi-axis m. The matrix A = m S^-1 B^T converts camera axes to whitened axes; S is the diagonal matrix of
    the semi-axes. ``ref`` is the direction to the anchor with camera-z 1. ``w`` is (anchor - centre)/m in camera axes.
    ``tc`` is the anchor's depth / m, and ``near`` is (depth of the near plane - anchor's depth)/m.
    """

    A: wp.mat33d
    ref: wp.vec3d
    w: wp.vec3d
    e0: wp.vec3d
    ex: wp.vec3d
    ey: wp.vec3d
    xa: wp.vec3d
    tc: wp.float64
    tu: wp.float64
    tv: wp.float64
    near: wp.float64


@wp.func
def round_projected_to_float32(x: wp.float64):
    """Return ``x`` rounded to the nearest float32."""
    return wp.float64(wp.float32(x))


@wp.func
def load_projection_view(matrix: Doubles, intrinsics: wp.vec4d, near: wp.float64):
    """Return the :class:`View` of ``matrix``, the 16 numbers of a world-to-camera matrix, on the device."""
    v = View()
    v.R = wp.mat33d(matrix[0], matrix[1], matrix[2], matrix[4], matrix[5], matrix[6], matrix[8], matrix[9], matrix[10])
    v.t = wp.vec3d(matrix[3], matrix[7], matrix[11])
    v.focal = wp.vec2d(intrinsics[0], intrinsics[1])
    v.centre = wp.vec2d(intrinsics[2], intrinsics[3])
    v.near = near
    return v


@wp.func
def project_primitive(mean: wp.vec3d, log_scale: wp.vec3d, quat: wp.vec4d, v: View):
    """Return a primitive's orientation, centre and anchor pixel in the view ``v``.

    The anchor is the pixel that shows the centre. If the primitive is near or behind the camera, or before the near
    plane, the anchor is the principal point, with depth 0. The anchor is rounded to float32 *before* its use, so that
    pixel kernels subtract the same value.
    """
    one, two = d(1.0), d(2.0)
    p = ProjectedPrimitive()
    n = one / wp.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    w, x, y, z = quat[0] * n, quat[1] * n, quat[2] * n, quat[3] * n
    p.local = wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip
    p.inverse = n
    top = wp.max(wp.max(log_scale[0], log_scale[1]), log_scale[2])
    m = wp.exp(top)
    p.m = m
    p.axes = wp.vec3d(wp.exp(log_scale[0] - top), wp.exp(log_scale[1] - top), wp.exp(log_scale[2] - top))
    c = v.R * mean + v.t
    p.centre = c
    p.B = v.R * p.local
    p.anchor = wp.vec3d(
        d(0.0), round_projected_to_float32(v.centre[0]), round_projected_to_float32(v.centre[1])
    )  # for a primitive near or behind the camera, or wholly before the near plane
    if c[2] > _ANCHOR_RADII * m and c[2] + m > v.near:
        p.anchor = wp.vec3d(
            m * round_projected_to_float32(c[2] / m),
            round_projected_to_float32(v.focal[0] * c[0] / c[2] + v.centre[0]),
            round_projected_to_float32(v.focal[1] * c[1] / c[2] + v.centre[1]),
        )
    return p


@wp.func
def whiten_rays(p: ProjectedPrimitive, v: View):
    """Return the rays of all pixels in whitened space, where the ellipsoid ``p`` is the unit sphere."""
    r = Ray()
    r.tc = p.anchor[0] / p.m
    r.ref = wp.vec3d((p.anchor[1] - v.centre[0]) / v.focal[0], (p.anchor[2] - v.centre[1]) / v.focal[1], d(1.0))
    r.w = r.tc * r.ref - p.centre / p.m
    x, y, z = p.axes[0], p.axes[1], p.axes[2]
    r.A = wp.mat33d(
        p.B[0, 0] / x, p.B[1, 0] / x, p.B[2, 0] / x,
        p.B[0, 1] / y, p.B[1, 1] / y, p.B[2, 1] / y,
        p.B[0, 2] / z, p.B[1, 2] / z, p.B[2, 2] / z,
    )  # fmt: skip
    r.e0 = r.A * r.ref
    r.ex = wp.vec3d(r.A[0, 0], r.A[1, 0], r.A[2, 0]) / v.focal[0]
    r.ey = wp.vec3d(r.A[0, 1], r.A[1, 1], r.A[2, 1]) / v.focal[1]
    r.xa = r.A * r.w
    aa = wp.dot(r.e0, r.e0)
    r.tu = -r.tc * wp.dot(r.ex, r.e0) / aa
    r.tv = -r.tc * wp.dot(r.ey, r.e0) / aa
    r.near = (v.near - p.anchor[0]) / p.m
    return r
