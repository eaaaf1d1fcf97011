"""Which runs a scene in chunks is made of."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, scene_of, suspects_of, task_of
from neuprim.config.overrides import drop_place, quote_override
from neuprim.core.errors import ConfigError
from neuprim.core.task import Chunks
from neuprim.plugins.blame import blamed
from neuprim.runs.events import Events, Preparing
from neuprim.runs.open import LOGS, context_of

__all__ = ["FOLDER", "TOGETHER", "Plan", "chunks_of", "plan_of"]

FOLDER = "chunks"
"""Of a run directory: the runs of its chunks."""

TOGETHER = 0.2
"""Share of the budget in which the joined model is trained as one: what lies on both sides of a seam gets used to each
other, and numbers settle.
More of it is a loss, as chunks are what learns (docs/dynamic.md)."""

_FEWEST = 8
"""Primitives of a chunk, at least: their sizes follow from the distances between them."""


@dataclass(frozen=True)
class Plan:
    """What is to be done.

    Attributes:
        chunks: how the scene's task divides it and puts it together.
        configs: of the chunks' runs.
        steps: that the joined model is trained for; None: as many as fit into ``seconds``.
    """

    chunks: Chunks
    configs: tuple[RunConfig, ...]
    steps: int | None
    seconds: float | None

    def facts(self) -> list[dict[str, Any]]:
        """What tells one division from another, JSON-able."""
        return [
            {
                "name": config.output_dir.name,
                "primitives": config.model.primitives,
                "iterations": config.train.iterations,
                "max_seconds": config.train.max_seconds,
            }
            for config in self.configs
        ]


def chunks_of(config: RunConfig, events: Events) -> Chunks | None:
    """How the scene of a configuration is fitted in chunks; None for in one.

    Raises:
        NeuprimError: what the scene refuses.
    """
    load = scene_of(config, task_of(config)).spec.chunks
    assert load is not None, "somebody asked for chunks"
    context = context_of(config, lambda text, fraction: events(Preparing(text, fraction)))
    scene = suspects_of(config).scene
    with blamed(scene.origin, f"chunks of {scene.what}", config.output_dir / LOGS):
        return load(config.to_dict(), context)


def plan_of(config: RunConfig, chunks: Chunks) -> Plan:
    """The runs of the chunks, with their shares of primitives and budget.

    Raises:
        ConfigError: fewer primitives than the chunks need.
    """
    least = _FEWEST * len(chunks.parts)
    if config.model.primitives < least:
        raise ConfigError(
            f"model.primitives={config.model.primitives}: expected at least {least} for {len(chunks.parts)} chunks"
        )
    primitives = _shared(config.model.primitives - least, [part.primitives for part in chunks.parts])
    configs = []
    for part, own in zip(chunks.parts, primitives, strict=True):
        share = (1 - TOGETHER) * part.steps
        settings = {**part.settings, "model.primitives": own + _FEWEST, **_schedule(config, share)}
        configs.append(_changed(config, settings, config.output_dir / FOLDER / part.name))
    train = config.train
    steps = None if train.iterations is None else round(TOGETHER * train.iterations)
    return Plan(chunks, tuple(configs), steps, None if train.max_seconds is None else TOGETHER * train.max_seconds)


def _schedule(config: RunConfig, share: float) -> dict[str, Any]:
    """The training of a part in a share of the whole's budget; it has as many interventions into its population as the
    whole has."""
    train = config.train
    found: dict[str, Any] = {"train.population.every": max(round(share * train.population.every), 1)}
    if train.iterations is not None:
        found["train.iterations"] = max(round(share * train.iterations), 1)
    if train.max_seconds is not None:
        found["train.max_seconds"] = share * train.max_seconds
    return found


def _shared(total: int, parts: list[float]) -> list[int]:
    """Whole numbers close to these shares of ``total`` that add up to it."""
    ends = [round(total * sum(parts[: n + 1]) / sum(parts)) for n in range(len(parts))]
    return [end - begin for begin, end in zip([0, *ends], ends, strict=False)]


def _changed(config: RunConfig, settings: dict[str, Any], directory: Path) -> RunConfig:
    """A configuration with other settings, by dotted key, as if they had been typed."""
    tree = copy.deepcopy(config.to_dict())
    for key, value in settings.items():
        *path, name = key.split(".")
        node = tree
        for group in path:
            node = node[group]
        tree["non_default"][key] = [node.get(name), value]
        node[name] = value
    tree["output_dir"] = str(directory)
    tree["overrides"] = [
        *drop_place(config.overrides),
        *(quote_override(key, value) for key, value in settings.items()),
    ]
    return RunConfig.from_dict(tree)
