"""What fields hand to the renderer, checked at every entrance to it: one line that names field, tensor, found and expected.

Compiled kernels index without looking. A tensor that is too short would be read and written beyond its end, one of another layout
would be read as something else, and torch would broadcast what does not fit. Here every closed form has a row of a table, its
tensors have the sizes they share, and the first that does not fit is named. That costs microseconds per frame
(``benchmarks/form_checks.py``).

Tensors are float32 or float64, in any mix, dense and on the CPU; their strides do not matter, as backends copy what is not contiguous.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.fields import MOST_UNITS, ColourField, Constant, Cosine, DensityField, Field, Opaque, OpaqueColour, RayNet, Shading
from neuprim.core.geometry import Geometry
from neuprim.core.schema import InitContext, ParameterSpec

if TYPE_CHECKING:
    from neuprim.core.primitives import Lowered

__all__ = [
    "Shape",
    "Sizes",
    "check_channels",
    "check_colour",
    "check_density",
    "check_geometry",
    "check_halves",
    "check_lowered",
    "check_result",
    "check_rows",
    "check_shading",
    "check_shape",
    "check_start",
    "check_sum",
    "check_tensors",
    "method",
    "misfit",
    "number_fault",
    "tensor_fault",
    "tensors_fault",
]

Shape = tuple[int | str, ...]
"""A letter stands for a size that tensors share."""

Sizes = dict[str, tuple[int, str]]
"""Letter -> its size and the tensor that has it."""

_TABLE: dict[type, dict[str, tuple[Shape, ...]]] = {
    Geometry: {"means": (("N", 3),), "log_scales": (("N", 3),), "quats": (("N", 4),)},
    Cosine: {"W1": (("N", "K", 3),), "b1": (("N", "K"),), "w2": (("N", "K"),), "b2": (("N", 1), ("N",))},
    Constant: {"rgb": (("N", "C"),)},
    RayNet: {"Wx": (("N", "H", 3),), "bias": (("N", "H"),), "base": (("N", "C"),), "Wout": (("N", "C", "H"),)},
}
_RANGES = {"K": (0, MOST_UNITS), "H": (0, MOST_UNITS), "C": (1, sys.maxsize)}
_DTYPES = (torch.float32, torch.float64)
_DENSITIES, _COLOURS = (Cosine, Opaque), (Constant, RayNet, OpaqueColour)


# ---------------------------------------------------------------- in words: what is wrong with a tensor, None where nothing is


def tensor_fault(value: Any) -> str | None:
    """``"dtype torch.int64; expected torch.float32 or torch.float64"`` and the like of what no kernel can read."""
    if not isinstance(value, Tensor):
        return f"type {type(value).__name__}; expected a torch tensor"
    if value.device.type != "cpu":
        return f"device {value.device}; expected cpu, where both backends compute"
    if value.layout is not torch.strided or value.is_nested:
        return f"layout {'nested' if value.is_nested else value.layout}; expected a dense tensor"
    if value.dtype not in _DTYPES:
        return f"dtype {value.dtype}; expected torch.float32 or torch.float64"
    return None


def number_fault(value: Any) -> str | None:
    """The same of what should be a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"type {type(value).__name__}; expected a finite number"
    if abs(value) <= sys.float_info.max:
        return None
    return f"value {value if isinstance(value, float) else 'beyond the range of float64'}; expected a finite number"


def function_fault(value: Any) -> str | None:
    """The same of what should be a function."""
    return None if callable(value) else f"type {type(value).__name__}; expected a function"


def tensors_fault(tensors: Iterable[tuple[str, Any, tuple[Shape, ...]]], sizes: Sizes) -> str | None:
    """The first of (name, tensor, shapes that it may have) that does not fit; ``sizes`` gets what the others add."""
    for name, value, shapes in tensors:
        fault = tensor_fault(value)
        if fault is None and not any(_fits(value.shape, shape, name, sizes) for shape in shapes):
            fault = f"shape {tuple(value.shape)}; expected {_expected(shapes, sizes)}"
        if fault is not None:
            return f"{name} has {fault}"
    return None


def misfit(form: Any, sizes: Sizes) -> str | None:
    """The first part of a form that does not fit, e.g. ``"w2 has shape (5,); expected (100, 3), as means has N=100 and W1 has K=3"``.

    Args:
        form: one of the closed forms, or the ellipsoids.
        sizes: those known so far; gets the ones that this form adds.
    """
    table = next((table for kind, table in _TABLE.items() if isinstance(form, kind)), {})
    fault = tensors_fault(((name, getattr(form, name), shapes) for name, shapes in table.items()), sizes)
    if fault is not None:
        return fault
    if isinstance(form, Cosine):
        return _of("omega0", number_fault(form.omega0))
    if isinstance(form, Opaque):
        return _of("line_integral", function_fault(form.line_integral))
    if isinstance(form, OpaqueColour):
        if isinstance(form.channels, bool) or not isinstance(form.channels, int) or form.channels < 1:
            return f"channels has value {form.channels!r}; expected a whole number of at least 1"
        sizes["C"] = (form.channels, "channels")
        return _of("radiance", function_fault(form.radiance))
    return None


def _of(name: str, fault: str | None) -> str | None:
    return None if fault is None else f"{name} has {fault}"


def _fits(found: torch.Size, shape: Shape, name: str, sizes: Sizes) -> bool:
    if len(found) != len(shape):
        return False
    fresh: Sizes = {}
    for size, want in zip(found, shape, strict=True):
        if isinstance(want, str):
            if want not in sizes:
                low, high = _RANGES.get(want, (0, sys.maxsize))
                if not low <= size <= high:
                    return False
                fresh[want] = (size, name)
                continue
            want = sizes[want][0]
        if size != want:
            return False
    sizes.update(fresh)
    return True


def _expected(shapes: tuple[Shape, ...], sizes: Sizes) -> str:
    """In numbers where all are known, else in letters with what is known of them."""
    letters = list(dict.fromkeys(d for d in shapes[0] if isinstance(d, str)))
    known, free = [x for x in letters if x in sizes], [x for x in letters if x not in sizes]
    if not free:
        numbers = [tuple(sizes[d][0] if isinstance(d, str) else d for d in shape) for shape in shapes]
        tensors = dict.fromkeys(sizes[x][1] for x in known)
        origins = " and ".join(f"{t} has " + " and ".join(f"{x}={sizes[x][0]}" for x in known if sizes[x][1] == t) for t in tensors)
        return " or ".join(map(str, numbers)) + (f", as {origins}" if origins else "")
    text = " or ".join(str(shape).replace("'", "") for shape in shapes)
    origins = " and ".join(f"{x}={sizes[x][0]} as in {sizes[x][1]}" for x in known)
    limits = [f", {x} {'at least' if low else 'at most'} {low or high}" for x, (low, high) in _RANGES.items() if x in free]
    return text + (f" with {origins}" if origins else "") + "".join(limits)


# ---------------------------------------------------------------- entrances


def source(kind: str, field: str | None) -> str:
    """``"density field Waves"``, or ``"density"`` where no field is known."""
    return kind if field is None else f"{kind} field {field}"


def method(field: Field, name: str) -> str:
    """``"density field Waves: on_split"``: a method as its author writes it."""
    return f"{source('density' if isinstance(field, DensityField) else 'colour', type(field).__name__)}: {name}"


def check_geometry(geometry: Any, who: str, count: int | None = None) -> Sizes:
    """The sizes that the tensors of ellipsoids share; ``count`` is how many there must be, where that is known.

    Raises:
        FormError: they do not; names ``who``, tensor, found and expected.
    """
    if not isinstance(geometry, Geometry):
        raise FormError(f"{who} has type {type(geometry).__name__}; expected Geometry")
    sizes: Sizes = {} if count is None else {"N": (count, "the geometry given")}
    fault = misfit(geometry, sizes)
    if fault is not None:
        raise FormError(f"{who}: {fault}")
    return sizes


def check_density(density: Any, sizes: Sizes, field: str | None) -> None:
    """Raise :class:`FormError` unless a lowered density fits; ``sizes`` are those of :func:`check_geometry`."""
    _check_form("density", density, _DENSITIES, sizes, field)


def check_colour(colour: Any, sizes: Sizes, field: str | None) -> None:
    """The same of a lowered colour."""
    _check_form("colour", colour, _COLOURS, sizes, field)


def _check_form(kind: str, form: Any, kinds: tuple[type, ...], sizes: Sizes, field: str | None) -> None:
    if not isinstance(form, kinds):
        names = ", ".join(k.__name__ for k in kinds[:-1])
        raise FormError(f"{source(kind, field)} lowered to {type(form).__name__}; expected {names} or {kinds[-1].__name__}")
    fault = misfit(form, sizes)
    if fault is not None:
        raise FormError(f"{source(kind, field)} lowered to {type(form).__name__}: {fault}")


def check_sum(first: Cosine, second: Cosine) -> None:
    """Raise :class:`FormError` unless both fit, are of the same primitives and have a sum that can be drawn."""
    sizes: Sizes = {}
    for word, form in (("first", first), ("second", second)):
        sizes.pop("K", None)
        fault = misfit(form, sizes)
        if fault is not None:
            raise FormError(f"sum of two Cosine forms: the {word}: {fault}")
    first_count, second_count = first.W1.shape[1], second.W1.shape[1]
    if first_count + second_count > MOST_UNITS:
        raise FormError(f"sum of two Cosine forms: {first_count} + {second_count} neurons; expected at most {MOST_UNITS}")


def check_lowered(lowered: Lowered, viewmat: Any = None, background: Any = None) -> None:
    """Everything that a renderer takes, at its entrance.

    Raises:
        FormError: something does not fit; names field (where the model knows it), form, tensor, found and expected.
    """
    density, colour = lowered.fields or (None, None)
    sizes = check_geometry(lowered.geometry, "geometry")
    check_density(lowered.density, sizes, density)
    check_colour(lowered.colour, sizes, colour)
    if lowered.rows is not None:
        check_rows(lowered.rows, None, "Lowered.rows holds", sizes["N"][0])
    if lowered.shade is not None and (fault := function_fault(lowered.shade)) is not None:
        raise FormError(f"{lowered.owner('colour')}: shade has {fault} or None")
    if background is not None:
        channels = sizes["C"][0]
        check_shape("background", background, (channels,), f", as {lowered.source('colour')} has C={channels}")
    if viewmat is not None:
        check_shape("viewmat", viewmat, (4, 4))


def check_channels(found: int, colour: ColourField) -> None:
    """Raise :class:`FormError` unless a lowered colour has as many channels as its field says, which are the data set's."""
    if found != colour.channels:
        raise FormError(
            f"{method(colour, 'lower')} returned a colour of C={found}; expected {colour.channels}, as its member channels says"
        )


def check_shape(name: str, value: Any, shape: tuple[int, ...], why: str = "") -> None:
    """Raise :class:`FormError` unless ``value`` is a tensor of this shape that a kernel can read."""
    fault = tensor_fault(value)
    if fault is None and value.shape != shape:
        fault = f"shape {tuple(value.shape)}; expected {shape}{why}"
    if fault is not None:
        raise FormError(f"{name} has {fault}")


def check_rows(rows: Any, model: int | None, who: str, length: int | None = None) -> None:
    """Raise :class:`FormError` unless ``rows`` are ascending int64 rows (M,) of a ``model`` of so many primitives, ``length`` of them."""
    found = None
    if not isinstance(rows, Tensor):
        found = f"type {type(rows).__name__}"
    elif rows.device.type != "cpu" or rows.layout is not torch.strided or rows.dtype != torch.int64 or rows.dim() != 1:
        found = f"{rows.dtype} {tuple(rows.shape)} on {rows.device}"
    elif length is not None and len(rows) != length:
        found = f"{len(rows)} rows for {length} primitives"
    elif len(rows):
        first, last = int(rows[0]), int(rows[-1])
        if first < 0 or (model is not None and last >= model):
            found = f"rows {first} to {last}"
        elif not bool((rows[1:] > rows[:-1]).all()):
            found = f"rows that do not ascend, {rows[:8].tolist()}{' ...' if len(rows) > 8 else ''}"
    if found is not None:
        limit = "" if model is None else f" from 0 to {model - 1}"
        raise FormError(f"{who} {found}; expected ascending int64 rows (M,){limit}")


def check_result(value: Any, shape: tuple[int, ...], who: str) -> Tensor:
    """What a field's own code returned: a dense tensor of real numbers on the CPU, of this shape.

    Raises:
        FormError: it is something else; ``who`` names field and method.
    """
    if isinstance(value, Tensor) and value.device.type == "cpu" and value.layout is torch.strided and value.is_floating_point():
        if value.shape == shape:
            return value
        raise FormError(f"{who} returned shape {tuple(value.shape)}; expected {shape}, a row for each of the {shape[0]} that it was given")
    found = f"{value.dtype} {value.layout} on {value.device}" if isinstance(value, Tensor) else f"type {type(value).__name__}"
    raise FormError(f"{who} returned {found}; expected a dense tensor of real numbers on the cpu")


def check_shading(found: Any, count: int, who: str) -> Shading:
    """What ``shade`` returned, for ``count`` primitives; None is no shading.

    Raises:
        FormError: it is something else; ``who`` names field and method.
    """
    if found is None:
        return Shading()
    if not isinstance(found, Shading):
        raise FormError(f"{who} returned type {type(found).__name__}; expected Shading or None")
    if found.primitives is not None:
        check_result(found.primitives, (count,), f"{who}: primitives")
    return found


def check_start(spec: ParameterSpec, context: InitContext, who: str) -> Tensor:
    """The float32 start value (N, *shape) that a parameter's own initialiser draws.

    Raises:
        FormError: it is of another shape; names ``who`` and the parameter.
    """
    value, shape = spec.init(context), (context.count, *spec.shape)
    if not isinstance(value, Tensor):
        raise FormError(f"{who}: {spec.name}: init returned type {type(value).__name__}; expected a torch tensor")
    if value.shape != shape:
        raise FormError(f"{who}: {spec.name}: init returned shape {tuple(value.shape)}; expected {shape}")
    return value.float().contiguous()


def check_tensors(found: Any, like: Mapping[str, Tensor], who: str) -> dict[str, Tensor]:
    """A field's own parameters from one of its methods: names, shapes and dtypes of ``like``.

    Raises:
        FormError: they are not; ``who`` names field and method.
    """
    if not isinstance(found, Mapping):
        raise FormError(f"{who} returned type {type(found).__name__}; expected a dict of tensors by name")
    if set(found) != set(like):
        raise FormError(f"{who} returned tensors {sorted(map(str, found))}; expected {sorted(like)}")
    for name, wanted in like.items():
        fault = tensor_fault(found[name])
        if fault is None and found[name].shape != wanted.shape:
            fault = f"shape {tuple(found[name].shape)}; expected {tuple(wanted.shape)}"
        if fault is None and found[name].dtype != wanted.dtype:
            fault = f"dtype {found[name].dtype}; expected {wanted.dtype}"
        if fault is not None:
            raise FormError(f"{who}: {name} has {fault}")
    return dict(found)


def check_halves(found: Any, like: Mapping[str, Tensor], place: Geometry, who: str) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
    """What ``divide`` returned: a mask of P parents, and tensors and geometry of 2 P rows like ``like`` and ``place``.

    Raises:
        FormError: it is something else; ``who`` names field and method.
    """
    if not isinstance(found, tuple) or len(found) != 3:
        raise FormError(f"{who} returned type {type(found).__name__}; expected (mask, tensors, Geometry) or None")
    mask, halves, where = found
    parents = place.count // 2
    if not isinstance(mask, Tensor) or mask.device.type != "cpu" or mask.dtype != torch.bool or mask.shape != (parents,):
        of = f"{mask.dtype} {tuple(mask.shape)} on {mask.device}" if isinstance(mask, Tensor) else f"type {type(mask).__name__}"
        raise FormError(f"{who} returned a mask of {of}; expected torch.bool ({parents},)")
    if not isinstance(where, Geometry):
        raise FormError(f"{who} returned a geometry of type {type(where).__name__}; expected Geometry")
    names = ("means", "log_scales", "quats")
    rows, stored = ({name: getattr(g, name) for name in names} for g in (where, place))
    return mask, check_tensors(halves, like, who), check_tensors(rows, stored, who)
