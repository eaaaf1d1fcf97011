"""Editable installations whose metadata are older than their sources: an entry point added since is not there yet."""

from __future__ import annotations

import json
import shlex
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import urlparse
from urllib.request import url2pathname

from neuprim.plugins.names import normalised

__all__ = ["not_installed_yet"]

_LARGEST = 1_000_000  # bytes of a pyproject.toml


def not_installed_yet(group: str, name: str, package: str | None = None) -> str:
    """``"; FILE registers it, but ..."`` where the source of an editable installation has an entry point that its
    metadata lack, else "".

    Args:
        group: of entry points.
        package: normalised name of the one distribution to look at; None: all.
    """
    for dist in metadata.distributions():
        try:
            folder = _source(dist)
            if folder is None or package not in (None, normalised(dist.metadata["Name"] or "")):
                continue
            if name in _declared(folder / "pyproject.toml", group):
                again = f"pip install -e {shlex.quote(str(folder))}"
                return f"; {folder / 'pyproject.toml'} registers it, but was installed before it did: run {again} again"
        except Exception:  # a damaged distribution or file is no hint
            continue
    return ""


def _source(dist: metadata.Distribution) -> Path | None:
    """The folder an editable installation leads to; None for other installations."""
    text = dist.read_text("direct_url.json")
    if text is None:
        return None
    record = json.loads(text)
    if not record.get("dir_info", {}).get("editable"):
        return None
    url = urlparse(record["url"])
    return Path(url2pathname(url.path)) if url.scheme == "file" else None


def _declared(file: Path, group: str) -> set[str]:
    if file.stat().st_size > _LARGEST:
        return set()
    data: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    standard = data.get("project", {}).get("entry-points", {}).get(group, {})
    poetry = data.get("tool", {}).get("poetry", {}).get("plugins", {}).get(group, {})
    return {*standard, *poetry}
