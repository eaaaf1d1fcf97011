"""Whether a configuration asks for chunks."""

from __future__ import annotations

from neuprim.config import RunConfig
from neuprim.core.errors import ConfigError

__all__ = ["asked", "refuse_chunks"]


def asked(config: RunConfig) -> bool:
    """Whether a scene is to be fitted in chunks; only scenes that can be have the setting."""
    return config.scene.get("chunks") not in (None, 1)


def refuse_chunks(config: RunConfig, what: str) -> None:
    """Raises ConfigError where something that trains one model at once is asked to do it in chunks."""
    if asked(config):
        raise ConfigError(f"scene.chunks={config.scene['chunks']}: {what}; expected scene.chunks=null")
