"""neuprim: radiance fields made of splattable neural primitives."""

from typing import TYPE_CHECKING, Any

from neuprim.version import __version__

if TYPE_CHECKING:
    from neuprim.functional import rasterize as rasterize

__all__ = ["__version__", "rasterize"]


def __getattr__(name: str) -> Any:
    """Import :func:`~neuprim.functional.rasterize` on first use, so that ``import neuprim`` does not load torch."""
    if name == "rasterize":
        from neuprim.functional import rasterize

        globals()[name] = rasterize
        return rasterize
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
