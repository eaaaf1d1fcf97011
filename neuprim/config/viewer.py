"""The words that ask for a viewer beside a training: ``viewer=true viewer.port=8080``.

They say nothing about the run itself, so they are taken out of the words after ``neuprim run`` here and no file keeps
them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from neuprim.config.overrides import key_of, parse, swept_keys
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Range, coerce, nonempty_text, validate, validate_fields

__all__ = ["LOOPBACK", "ViewerSettings", "viewer_words"]

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class ViewerSettings:
    """Where a viewer listens.

    Attributes:
        host: an address of this machine; the default is reached from this machine alone.
        port: 0 for any that is free.
    """

    host: Annotated[str, nonempty_text("an address of this machine")] = LOOPBACK
    port: Annotated[int, Range(0, 65535, says="a port, 1 to 65535, or 0 for any")] = 8080

    def __post_init__(self) -> None:
        validate_fields(self, "viewer")


def viewer_words(words: Sequence[str]) -> tuple[ViewerSettings | None, list[str]]:
    """The viewer that is asked for, None for none, and the other words. A word about its host or port asks for it, too.

    Raises:
        ConfigError: no such setting, several values, or an impossible one.
    """
    own = [word for word in words if _is_own(word)]
    for key in swept_keys(own):
        raise ConfigError(f"{key}: several values; expected one")
    wanted, given = bool(own), {}
    for assignment in parse(own):
        head, dot, name = assignment.key.partition(".")
        if not dot:
            wanted = coerce(assignment.value, bool, "viewer")
        else:
            names = [field.name for field in dataclasses.fields(ViewerSettings)]
            if name not in names:
                raise ConfigError(f"{assignment.key}: no such setting{nearest(name, names, prefix=f'{head}.')}")
            given[name] = assignment.value
    settings = validate(ViewerSettings, given, "viewer")
    return (settings if wanted else None), [word for word in words if not _is_own(word)]


def _is_own(word: str) -> bool:
    key = key_of(word)
    return key == "viewer" or key.startswith("viewer.")
