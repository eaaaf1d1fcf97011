"""What cannot be trained in parts, each in one line."""

from __future__ import annotations

from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.population import TABLE, Population
from neuprim.core.train.settings import TrainSettings

__all__ = ["refuse_parts"]


def refuse_parts(settings: TrainSettings, population: Population, model: Primitives, ranks: int) -> None:
    """Refuse ``train.shard`` where a step or an intervention needs more of the model than a rank has.

    Raises:
        ConfigError: names the setting that does.
    """
    if not population.plans:
        known = " or ".join(name for name, made in TABLE.items() if made.plans)
        raise ConfigError(f"train.population.strategy={settings.population.strategy} with train.shard=true: it decides on the whole model; expected {known}")
    if settings.anisotropy_weight > 0:
        raise ConfigError(
            f"train.anisotropy_weight={settings.anisotropy_weight:g} with train.shard=true: a mean over the whole model that no rank has; expected 0"
        )
    if model.count < ranks:
        raise ConfigError(f"train.shard=true: {model.count} primitives for {ranks} ranks; expected one for each at least")
