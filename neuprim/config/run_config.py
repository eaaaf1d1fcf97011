"""The typed configuration of one run, and its form on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import yaml

from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.io.plain import load_yaml
from neuprim.core.render import backends
from neuprim.core.settings import MetricsSettings, RenderSettings
from neuprim.core.train import population
from neuprim.core.train.settings import ModelSettings, TrainSettings
from neuprim.core.used_settings import OPTIONAL
from neuprim.core.validation import Range, refuse_unknown, validate, validate_fields
from neuprim.plugins.names import split
from neuprim.plugins.provenance import MadeBy

__all__ = ["RunConfig", "RunSettings"]

MAX_BYTES = 1_000_000
"""A configuration has a few kilobytes; anything larger is another file."""


@dataclass
class RunSettings:
    """The part of the configuration that is the same for every task; defaults are a run's defaults."""

    model: ModelSettings = field(default_factory=ModelSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    renderer: RenderSettings = field(default_factory=lambda: RenderSettings(near="auto"))
    metrics: MetricsSettings = field(default_factory=MetricsSettings)
    output_dir: str | None = None
    seed: Annotated[int, Range(0, 2**63 - 1, says="a whole number from 0 to 2^63 - 1")] = 0
    resume: bool = False

    def __post_init__(self) -> None:
        validate_fields(self, "")
        backends.check_backend_name(self.renderer.backend)
        backends.check_backend_device(self.renderer)
        population.check_strategy(self.train.population.strategy)


@dataclass
class RunConfig:
    """Everything a run depends on, validated.

    Attributes:
        task, scene_name, preset: what was chosen.
        scene: the scene's own settings, as its loader takes them.
        options: the task's own settings and those of its loss (``task.options``).
        unused: names of the shared settings that nothing in this run reads; ``config.yaml`` does not show them.
        output_dir: the run's directory; it need not exist yet.
        seed: of every random number the run draws.
        resume: continue from the checkpoint in ``output_dir``, if there is one.
        overrides: what the user typed.
        non_default: dotted key -> (value with the same task, scene and preset and nothing typed, value of this run).
        source: the file that it was read from; None for one that the user composed. See :mod:`neuprim.config.trust`.
        made_by: the packages that task, scene and loss come from; None where nobody said, and their names alone decide.
    """

    task: str
    scene_name: str
    scene: dict[str, Any]
    preset: str
    model: ModelSettings
    train: TrainSettings
    renderer: RenderSettings
    output_dir: Path
    metrics: MetricsSettings = field(default_factory=MetricsSettings)
    seed: int = 0
    resume: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    overrides: list[str] = field(default_factory=list)
    non_default: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    made_by: MadeBy | None = None
    source: Path | None = field(default=None, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested values, in the layout of the command line's keys."""
        tree: dict[str, Any] = {
            "task": {"name": self.task, "options": self.options},
            "scene": {"name": self.scene_name, **self.scene},
            "preset": self.preset,
            "model": dataclasses.asdict(self.model),
            "train": dataclasses.asdict(self.train),
            "renderer": dataclasses.asdict(self.renderer),
            "metrics": dataclasses.asdict(self.metrics),
            "output_dir": str(self.output_dir),
            "seed": self.seed,
            "resume": self.resume,
            "overrides": list(self.overrides),
            "non_default": {key: list(pair) for key, pair in self.non_default.items()},
            **({} if self.made_by is None else {"made_by": self.made_by.to_dict()}),
        }
        for name in self.unused:
            group, _, key = name.partition(".")
            del tree[group][key]
        return tree

    def to_yaml(self) -> str:
        """The resolved configuration as YAML; :meth:`from_yaml` reads it back unchanged."""
        return yaml.dump(self.to_dict(), Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=120)

    @classmethod
    def from_yaml(cls, path: str | Path) -> RunConfig:
        """Reads a run directory's ``config.yaml`` (``path`` is the file or the directory); no code in it is run.

        Raises:
            CheckpointError: there is no such file, or it is not a run's configuration.
            ConfigError: a setting in it does not exist or has an impossible value.
        """
        file = Path(path)
        if file.is_dir():
            file = file / "config.yaml"
        elif file.name != "config.yaml" and not file.exists():
            raise CheckpointError(f"{path}: no such run directory")
        data = _read(file)
        try:
            return dataclasses.replace(cls.from_dict(data), source=file)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from error

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RunConfig:
        """What :meth:`to_dict` gave.

        Raises:
            ConfigError: a setting in it does not exist or has an impossible value.
        """
        known = [
            "task",
            "scene",
            "preset",
            *(f.name for f in dataclasses.fields(RunSettings)),
            "overrides",
            "non_default",
            "made_by",
        ]
        refuse_unknown(data, known, "")
        task, scene = _node(data, "task"), _node(data, "scene")
        common = validate(
            RunSettings, {f.name: data[f.name] for f in dataclasses.fields(RunSettings) if f.name in data}
        )
        if common.output_dir is None:
            raise ConfigError("output_dir: missing; expected a directory")
        overrides, non_default = data.get("overrides", []), data.get("non_default", {})
        if not isinstance(overrides, list) or not all(isinstance(o, str) for o in overrides):
            raise ConfigError("overrides: expected a list of texts")
        if not isinstance(non_default, dict) or not all(
            isinstance(p, list) and len(p) == 2 for p in non_default.values()
        ):
            raise ConfigError("non_default: expected KEY: [default, value] pairs")
        options = task.get("options", {})
        if not isinstance(options, dict):
            raise ConfigError("task.options: expected a mapping")
        made = cls(
            task=_text(task.get("name"), "task.name"),
            scene_name=_text(scene.get("name"), "scene.name"),
            scene={str(k): v for k, v in scene.items() if k != "name"},
            preset=_text(data.get("preset"), "preset"),
            model=common.model,
            train=common.train,
            renderer=common.renderer,
            metrics=common.metrics,
            output_dir=Path(common.output_dir),
            seed=common.seed,
            resume=common.resume,
            options=options,
            unused=tuple(name for name in OPTIONAL if not _has(data, name)),
            overrides=overrides,
            non_default={str(key): (pair[0], pair[1]) for key, pair in non_default.items()},
            made_by=MadeBy.from_dict(data["made_by"]) if data.get("made_by") is not None else None,
        )
        made._check_made_by()
        return made

    def _check_made_by(self) -> None:
        """Raises ConfigError for a record of makers that is not this run's."""
        record = self.made_by
        loss = None if self.train.loss is None else split(self.train.loss)[1]
        for kind, key, name in (
            ("task", "task.name", self.task),
            ("scene", "scene.name", self.scene_name),
            ("loss", "train.loss", loss),
        ):
            maker = None if record is None else getattr(record, kind)
            if maker is not None and maker.name != name:
                raise ConfigError(f"made_by.{kind}.name: found {maker.name!r}; expected {name!r}, as {key} says")


class _PlainDumper(yaml.SafeDumper):
    """Writes a value that occurs twice twice, instead of as an anchor and an alias."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _read(file: Path) -> Mapping[str, Any]:
    try:
        if file.stat().st_size > MAX_BYTES:
            raise CheckpointError(f"{file}: larger than {MAX_BYTES} bytes; not a run's configuration")
        data = load_yaml(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CheckpointError(f"{file}: missing; expected a directory written by `neuprim run`") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise CheckpointError(f"{file}{place}: damaged configuration ({problem})") from error
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: cannot be read ({type(error).__name__}: {error})") from error
    if not isinstance(data, Mapping):
        raise CheckpointError(f"{file}: not a run's configuration (expected a mapping, found {type(data).__name__})")
    return data


def _has(data: Mapping[str, Any], name: str) -> bool:
    group, _, key = name.partition(".")
    return key in (data.get(group) or {})


def _node(data: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    node = data.get(key)
    if not isinstance(node, Mapping):
        raise ConfigError(f"{key}: missing or not a mapping")
    return node


def _text(value: object, key: str) -> str:
    if not isinstance(value, str) or not value:
        raise ConfigError(f"{key}: missing; expected a name")
    return value
