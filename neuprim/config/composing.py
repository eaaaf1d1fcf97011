"""From the words after ``neuprim run`` to a :class:`RunConfig`.

Values win in this order: what the user typed, the level of effort, the preset, the defaults of the settings
dataclasses. Hydra finds and composes the YAML files (its ``compose``, so nothing changes directory or writes files);
the settings dataclasses say which keys exist.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.config.comparing import differences, flat
from neuprim.config.declared import check_names, check_preset, check_typed, complete_options, options_of, unused
from neuprim.config.effort import EFFORT, LEVELS, Level, chosen_level
from neuprim.config.from_file import as_data, chosen_beside, settings_below
from neuprim.config.groups import check_groups, check_scene, presets, task_choices
from neuprim.config.outputs import DEFAULT_TASK, output_directory, run_name
from neuprim.config.overrides import Assignment, assigned, expand_sweep, key_of, parse, sweep_names, swept_keys
from neuprim.config.record import RunConfig, RunSettings
from neuprim.config.resuming import (
    begun_as,
    begun_run,
    chosen_again,
    new_words,
    not_installed,
    of_launch,
    refuse_contradictions,
    words_of_both,
)
from neuprim.config.schema import REQUIRED, defaults, is_free, like, setting_names
from neuprim.config.trust import check_stored, refuse_links
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.settings import MetricsSettings
from neuprim.core.used_settings import build_settings
from neuprim.core.validation import format_value, validate
from neuprim.plugins.blame import blamed
from neuprim.plugins.provenance import MadeBy, Maker
from neuprim.plugins.registry import LOSSES, TASKS, UnknownPlugin, find_scene, load_loss
from neuprim.version import __version__

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

__all__ = ["compose", "compose_all", "preset_settings"]

CHOICES = ("task", "scene", "preset", EFFORT)
PRESET_KEYS = ("model", "train", "renderer")
PATHS = "_paths_"
"""Key of a scene's YAML that lists which of its settings are paths: ``~`` is expanded and they are made absolute; URLs
stay."""

Files = dict[tuple[str, ...], Any]
"""Hydra's compositions by packages and group, so that a sweep reads each file once."""


def compose(overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None) -> RunConfig:
    """The configuration of one run.

    Args:
        overrides: ``key=value`` words in Hydra's grammar.
        check_output: refuse an ``output_dir`` that already holds files (unless ``resume=true``).
        stored: of an earlier run, whose settings stand under the overrides; in a directory of its own.

    Raises:
        ConfigError: one line that names the key, what was found and what was expected.
    """
    return _compose(overrides, check_output, {}, stored)


def _compose(overrides: Sequence[str], check_output: bool, files: Files, stored: RunConfig | None) -> RunConfig:
    assignments = parse(overrides)
    chosen = {key: _choice(assignments, key) for key in CHOICES}
    try:
        begun = begun_run(assignments, chosen, stored is not None)
        if begun is not None:
            return _resumed(begun, overrides, chosen, check_output, files, stored)
        if stored is not None:
            check_stored(stored, {a.key: a.value for a in assignments})
            chosen = chosen_beside(stored, chosen)
        return _composed(overrides, assignments, chosen, check_output, files, stored)
    except UnknownPlugin as error:
        told = not_installed(assignments, chosen["task"], chosen["scene"])
        if told is None:
            raise
        raise told from error


def _resumed(
    begun: RunConfig,
    overrides: Sequence[str],
    chosen: Mapping[str, str | None],
    check_output: bool,
    files: Files,
    stored: RunConfig | None,
) -> RunConfig:
    """The configuration of a run that goes on: its own, under what is typed now and not what was typed then."""
    assert begun.source is not None, "it was read from its directory"
    words = new_words(begun, overrides) if stored is None else list(overrides)
    assignments = parse(words)
    refuse_links(begun.source.parent)
    check_stored(begun, {a.key: a.value for a in parse(overrides)})
    chosen = {**chosen_again(begun, chosen), EFFORT: _choice(assignments, EFFORT)}
    return _composed(overrides, assignments, chosen, check_output, files, stored, begun)


def _composed(
    overrides: Sequence[str],
    assignments: Sequence[Assignment],
    chosen: Mapping[str, str | None],
    check_output: bool,
    files: Files,
    stored: RunConfig | None,
    begun: RunConfig | None = None,
) -> RunConfig:
    values = [a for a in assignments if a.key not in CHOICES]
    task_word = chosen["task"] or DEFAULT_TASK
    task_info, spec = TASKS.loaded(task_word)
    check_groups(spec)
    own = task_choices(spec)
    level = chosen_level(spec, chosen[EFFORT], chosen["preset"], presets(spec))
    preset = chosen["preset"] or (own.preset if level is None else level.preset)
    scene_word = chosen["scene"] or own.scene
    found = find_scene(spec, scene_word)
    scene_name, package = found.spec.name, found.config_package
    check_scene(spec, scene_name, package)
    if preset not in presets(spec):
        raise ConfigError(f"preset={preset}: task {spec.name!r} has no such preset{nearest(preset, presets(spec))}")

    base, declared_paths = _base(spec, scene_name, preset, own.options, files, package)
    again = (
        ()
        if begun is None
        else (a for a in settings_below(begun, scene_word, values) if a.key not in of_launch(overrides))
    )
    files_settings = (*again, *(() if stored is None else settings_below(stored, scene_word, values)))
    below = (*files_settings, *(() if level is None else level.settings))
    for assignment in (*below, *values):
        _check_key(assignment, base, scene_name)
    plain, full = _merge(base, values, below)
    settings = _settings(full)
    loss = None if settings.train.loss is None else LOSSES.loaded(settings.train.loss)
    declared = None if loss is None else loss[1]
    check_typed(spec, declared, values)
    options = _options(spec, declared, own.options, plain, full)
    check_names(spec, settings)
    with blamed(task_info, f"check of task {spec.name!r}"):
        spec.check(build_settings(spec, settings.model, options))
    scene = _scene(full["scene"], base["scene"], declared_paths)
    added = None if found.added_by is None else Maker.of(found.added_by, scene_name)
    directory = output_directory(settings.output_dir, run_name(task_word, scene_word), settings.resume, check_output)
    full["scene"] = scene
    if settings.metrics.lpips is not None:
        settings.metrics = MetricsSettings(str(Path(settings.metrics.lpips).expanduser().absolute()))
    changed = {"preset": (own.preset, preset)} if preset != own.preset else {}
    before = begun or stored
    made = RunConfig(
        task=spec.name,
        scene_name=scene_name,
        scene=scene,
        preset=preset,
        model=settings.model,
        train=settings.train,
        renderer=settings.renderer,
        metrics=settings.metrics,
        output_dir=directory,
        seed=settings.seed,
        resume=settings.resume,
        options=options,
        unused=unused(spec, declared),
        overrides=list(overrides) if before is None else words_of_both(before, overrides),
        non_default={**changed, **differences(_typed(plain), _typed(full, settings))},
        made_by=MadeBy(__version__, Maker.of(task_info), added, None if loss is None else Maker.of(loss[0])),
    )
    if begun is not None:
        refuse_contradictions(begun, made, declared_paths)
    return made


def compose_all(
    overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None
) -> list[RunConfig]:
    """The configurations of a sweep, each in its own sub-directory of one output directory; all are valid before one
    runs.

    Arguments and errors are those of :func:`compose`.
    """
    swept = set(swept_keys(overrides))
    if not swept:
        return [compose(overrides, check_output, stored)]
    combinations = expand_sweep(overrides)
    files: Files = {}
    resume = [
        word for word in overrides if key_of(word) == "resume"
    ]  # of each run below, not of one in the sweep's directory
    alone = [[word for word in c if key_of(word) != "resume"] for c in combinations]
    configs = [_compose([*c, "output_dir=null"], False, files, stored) for c in alone]
    first = configs[0]
    typed = parse(combinations[0])
    goes_on = any(a.value is True for a in parse(resume)[-1:])
    words = [(key, _choice(typed, key) or name) for key, name in (("task", first.task), ("scene", first.scene_name))]
    fixed = [run_name(word, "") for key, word in words if not swept & {key, "task"}]
    asked = [a.value for a in typed if a.key == "output_dir"]
    explicit = str(_compose(alone[0], False, files, stored).output_dir) if asked and asked[-1] is not None else None
    base = output_directory(explicit, "-".join([*fixed, "sweep"]), goes_on, check_output)
    names = sweep_names(overrides, combinations)
    made, recorded = [], (base / "sweep.json").is_file()
    for config, words_alone, name in zip(configs, alone, names, strict=True):
        begun = begun_as(base / name, words_alone) if goes_on else None
        if begun is True or (begun is False and not recorded):  # else the record of the sweep refuses other words
            config = _compose(
                [*words_alone, "resume=true", assigned("output_dir", str(base / name))], False, files, stored
            )
        own = [*(word for word in config.overrides if key_of(word) != "resume"), *resume]
        own = [word for word in own if word not in ("output_dir=null", assigned("output_dir", str(base / name)))]
        made.append(dataclasses.replace(config, output_dir=base / name, resume=goes_on, overrides=own))
    return made


# ---------------------------------------------------------------- choosing


def _choice(assignments: Sequence[Assignment], key: str) -> str | None:
    given = [a for a in assignments if a.key == key]
    if not given or given[-1].value is None:
        return None
    value = given[-1].value
    if not isinstance(value, (str, int, float)) or isinstance(value, bool) or not str(value):
        raise ConfigError(
            f"{given[-1].text}: expected "
            + (f"a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)" if key == EFFORT else f"the name of a {key}")
        )
    return str(value)


# ---------------------------------------------------------------- Hydra


def _hydra(spec: TaskSpec, packages: Sequence[str], groups: tuple[str, ...], files: Files) -> Any:
    key = (*packages, *groups)
    if key not in files:
        files[key] = _hydra_compose(spec, packages, groups)
    return files[key]


def _hydra_compose(spec: TaskSpec, packages: Sequence[str], groups: Sequence[str]) -> Any:
    """``packages`` hold the files; of two with one path the first package's counts."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_module
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        with initialize_config_module("neuprim.conf", version_base="1.3"):
            places = ",".join(f"pkg://{p}" for p in dict.fromkeys(packages))
            return hydra_compose("config", [f"hydra.searchpath=[{places}]", *groups])
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(
            f"task {spec.name!r}: its YAML files do not compose ({' '.join(str(error).split())})"
        ) from error


def _base(
    spec: TaskSpec, scene: str, preset: str, options: dict[str, Any], files: Files, package: str
) -> tuple[dict[str, Any], list[str]]:
    """Everything but the user's words, unresolved, and the names of the scene's settings that are paths.

    ``package`` holds the scene's file. A scene cannot replace a preset of the task, nor the task a scene of that
    package.
    """
    from omegaconf import OmegaConf

    scene_group, preset_group = f"+scene/{spec.name}@from_scene={scene}", f"+preset/{spec.name}@from_preset={preset}"
    task_first = (spec.config_package, package)
    if package == spec.config_package:
        composed = of_scene = _hydra(spec, task_first, (scene_group, preset_group), files)
    else:
        composed, of_scene = (
            _hydra(spec, task_first, (preset_group,), files),
            _hydra(spec, task_first[::-1], (scene_group,), files),
        )
    place, scene_place = f"preset/{spec.name}/{preset}.yaml", f"scene/{spec.name}/{scene}.yaml"
    scene_node = _plain(of_scene.get("from_scene"), resolve=False, place=scene_place)
    preset_node = _plain(composed.get("from_preset"), resolve=False, place=place)
    for key in preset_node:
        if key not in PRESET_KEYS:
            raise ConfigError(f"{place}: {key}: a preset may only set {', '.join(PRESET_KEYS)}")
    declared = scene_node.pop(PATHS, None) or []
    if not isinstance(declared, list) or any(name not in scene_node for name in declared) or "name" in scene_node:
        raise ConfigError(f"{scene_place}: {PATHS} must list keys of the file, and name is no setting")
    common = {k: v for k, v in _plain(composed, resolve=False).items() if not k.startswith("from_")}
    merged = OmegaConf.merge(defaults(RunSettings), common, preset_node)
    base = {**_plain(merged, resolve=False), "scene": scene_node, "task": {"options": options}}
    try:
        name = _settings(_plain(OmegaConf.create(base))).train.loss
        check_preset(spec, None if name is None else load_loss(name), preset_node)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from error
    return base, declared


def preset_settings(spec: TaskSpec, preset: str, scene: str, level: Level | None = None) -> RunSettings:
    """Settings of a preset, or of a level of effort over it, and a scene of a task, with nothing typed; the task need
    not be registered.

    Raises:
        ConfigError: its files lack something, do not compose, or hold an impossible value.
    """
    check_groups(spec)
    base, _ = _base(spec, scene, preset, {}, {}, spec.config_package)
    return _settings(_merge(base, [], () if level is None else level.settings)[1])


def _merge(
    base: Mapping[str, Any], values: Sequence[Assignment], below: Sequence[Assignment] = ()
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The resolved configuration without and with the user's values; ``below`` stand under them, and are not said by
    the user."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    tree = OmegaConf.create(copy.deepcopy(dict(base)))
    if _another_form(base, values):
        OmegaConf.update(tree, "model.density", {}, merge=False)
    for a in (*below, *values):
        try:
            OmegaConf.update(tree, a.key, as_data(a.value) if a.whole else a.value, merge=not a.whole, force_add=True)
        except (OmegaConfBaseException, ValueError, TypeError, AssertionError) as error:
            raise ConfigError(f"{a.text}: {' '.join(str(error).split())}") from error
    seconds = _said(values, "max_seconds")
    if seconds and seconds[-1] is not None and not _said(values, "iterations"):
        OmegaConf.update(tree, "train.iterations", None)  # a budget in seconds is used up, however fast the machine
    strategy = _said(values, "strategy", "train.population")
    if (
        strategy
        and strategy[-1] != base["train"]["population"]["strategy"]
        and not _said(values, "grow_from", "train.population")
    ):
        OmegaConf.update(tree, "train.population.grow_from", 1.0)  # the preset's is for populations that grow that way
    return _plain(OmegaConf.create(dict(base))), as_data(_plain(tree), back=True)


def _said(values: Sequence[Assignment], name: str, group: str = "train") -> list[Any]:
    """What the user's words say of a setting of a group, in their order."""
    whole = [{name: a.value} if a.key == f"{group}.{name}" else a.value if a.key == group else {} for a in values]
    return [given[name] for given in whole if isinstance(given, Mapping) and name in given]


def _another_form(base: Mapping[str, Any], values: Sequence[Assignment]) -> bool:
    """Whether the user chose another form of the density than the one whose settings the preset has; they would mean
    nothing to it."""
    own = (base["model"].get("density") or {}).get("form")
    typed = [a.value if a.key == "model.density.form" else a.value.get("form") for a in values if _says_form(a)]
    return own is not None and bool(typed) and typed[-1] not in (None, own)


def _says_form(a: Assignment) -> bool:
    return a.key == "model.density.form" or (a.key == "model.density" and isinstance(a.value, Mapping))


def _plain(node: Any, resolve: bool = True, place: str = "configuration") -> dict[str, Any]:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if node is None:
        return {}  # an empty file
    try:
        plain = OmegaConf.to_container(node, resolve=resolve)
    except OmegaConfBaseException as error:
        text = str(error).strip().splitlines()[0]
        raise ConfigError(f"{getattr(error, 'full_key', None) or place}: {text}") from error
    if not isinstance(plain, dict):
        raise ConfigError(f"{place}: expected a mapping of settings, found {type(plain).__name__}")
    return {str(k): v for k, v in plain.items()}


# ---------------------------------------------------------------- validating


def _settings(full: Mapping[str, Any]) -> RunSettings:
    return validate(RunSettings, {k: v for k, v in full.items() if k not in ("scene", "task")})


def _check_key(assignment: Assignment, base: Mapping[str, Any], scene_name: str) -> None:
    """Refuses a key that names no setting, with the nearest that do."""
    key, value = assignment.key, assignment.value
    path = key.split(".")
    head, rest = path[0], path[1:]
    scene: Mapping[str, Any] = base["scene"]
    if head == "scene" and rest and (rest[0] in scene) and (len(rest) == 1 or isinstance(scene[rest[0]], Mapping)):
        return
    if path[:2] == ["task", "options"]:
        return
    if head not in ("scene", "task") and all(path) and is_free(RunSettings, path):
        whole = rest == [] and head in PRESET_KEYS
        if whole and not isinstance(value, dict):
            raise ConfigError(f"{assignment.text}: {head} is a group of settings; set one of them as {head}.KEY=VALUE")
        return
    names = [*CHOICES, "task.options", *setting_names(RunSettings), *(f"scene.{k}" for k in scene)]
    if head == "scene" and rest:
        own = sorted(f"scene.{k}" for k in scene)
        hint = nearest(key, own) if own else "; it has none"
        raise ConfigError(f"{key}: no such setting of scene {scene_name!r}{hint}")
    inside = [n for n in names if n.startswith(head + ".")]
    raise ConfigError(f"{key}: no such setting" + nearest(key, inside or names))


def _options(
    spec: TaskSpec, loss: LossExtension | None, own: Mapping[str, Any], plain: dict[str, Any], full: dict[str, Any]
) -> dict[str, Any]:
    """All of ``task.options``, checked; ``plain`` and ``full`` get those without and with the user's values."""
    declared = options_of(spec, loss)
    owner = f"task {spec.name!r}" if loss is None or not loss.options else f"task {spec.name!r} with loss {loss.name!r}"
    for tree, given in ((plain, own), (full, full["task"]["options"])):
        tree["task"] = {"options": complete_options(declared, given, owner)}
    options: dict[str, Any] = full["task"]["options"]
    return options


def _scene(node: Mapping[str, Any], declared: Mapping[str, Any], paths: Sequence[str]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in node.items():
        where = f"scene.{key}"
        if key in paths and value is not None and value != REQUIRED:
            if not isinstance(value, (str, int)) or isinstance(value, bool) or not str(value).strip():
                raise ConfigError(f"{where}={format_value(value)}: expected a path (quote it: {where}='...')")
            value = str(value) if "://" in str(value) else str(Path(str(value)).expanduser().absolute())
        if declared[key] == REQUIRED and (value is None or value == REQUIRED):
            expected = f"expected a directory or file, as {where}=PATH" if key in paths else f"expected {where}=VALUE"
            raise ConfigError(f"{where}: required and not given; {expected}")
        result[key] = like(value, declared[key], where)
    return result


# ---------------------------------------------------------------- comparing


def _typed(full: Mapping[str, Any], settings: RunSettings | None = None) -> dict[str, Any]:
    """Flat dotted values, with the settings in their own types (so that 1 and 1.0 are the same rate)."""
    made = dataclasses.asdict(settings or _settings(full))
    tree = {**made, "scene": full["scene"], "task": full["task"]}
    del tree["output_dir"], tree["resume"]
    return flat(tree)
