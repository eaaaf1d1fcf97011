"""JavaScript that lies beside a field's own module: what the field is in a browser (docs/plugins.md, "In a
browser")."""

from __future__ import annotations

from importlib import resources

__all__ = ["read_script"]


def read_script(package: str, name: str) -> str:
    """The text of a script of an importable package, ``read_script(__package__, "density.js")``."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")
