"""Whether a configuration asks for chunks."""

from __future__ import annotations

from neuprim.config import RunConfig, scene_of, task_of
from neuprim.core.errors import ConfigError

__all__ = ["asked", "refuse_chunks"]


def asked(config: RunConfig) -> bool:
    """Whether a scene that can be fitted in chunks is to be; of another one the setting means something else."""
    return config.scene.get("chunks") not in (None, 1) and scene_of(config, task_of(config)).spec.chunks is not None


def refuse_chunks(config: RunConfig, what: str) -> None:
    """Raises ConfigError where something that trains one model at once is asked to do it in chunks."""
    if asked(config):
        raise ConfigError(f"scene.chunks={config.scene['chunks']}: {what}; expected scene.chunks=null")
