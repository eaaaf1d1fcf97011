"""What cannot be trained in parts, each in one line."""

from __future__ import annotations

from neuprim.core.errors import ConfigError
from neuprim.core.train.population import TABLE
from neuprim.core.train.settings import TrainSettings

__all__ = ["refuse_parts"]


def refuse_parts(settings: TrainSettings, ranks: int) -> None:
    """Refuse ``train.shard`` of one process, and where a step or an intervention needs more of the model than a rank
    has.

    Raises:
        ConfigError: names the setting that does.
    """
    if ranks == 1:
        raise ConfigError(
            "train.shard=true: one process has all primitives; expected several, as torchrun --nproc-per-node 2 -m neuprim run starts them"
        )
    if not TABLE[settings.population.strategy].plans:
        known = " or ".join(name for name, made in TABLE.items() if made.plans)
        raise ConfigError(
            f"train.population.strategy={settings.population.strategy} with train.shard=true: it decides on the whole model; expected {known}"
        )
    if settings.anisotropy_weight > 0:
        raise ConfigError(
            f"train.anisotropy_weight={settings.anisotropy_weight:g} with train.shard=true: a mean over the whole model that no rank has; expected 0"
        )
