"""Compose a :class:`RunConfig` from what users type after ``neuprim run``.

Values win in this order: what the user typed, a stored run's settings, the level of effort, the preset, the defaults of
the settings dataclasses. Hydra reads the overrides and composes the YAML files; OmegaConf merges them; the settings
dataclasses say which keys exist.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.config.checks import (
    CHOICES,
    GROUPS,
    REQUIRED,
    check_key,
    check_names,
    check_preset,
    check_typed,
    complete_options,
    differences,
    flatten,
    like_default,
    options_of,
    unused_settings,
)
from neuprim.config.outputs import DEFAULT_TASK, output_directory, run_name
from neuprim.config.overrides import (
    Assignment,
    expand_sweep,
    key_of,
    parse,
    quote_override,
    sweep_names,
    swept_keys,
)
from neuprim.config.run_config import RunConfig, RunSettings
from neuprim.config.stored_run import (
    changed_overrides,
    explain_missing_plugin,
    find_resumed_run,
    hide_references,
    launch_settings,
    merge_overrides,
    refuse_contradictions,
    resume_choices,
    stored_assignments,
    stored_choices,
    was_begun_with,
)
from neuprim.config.task_files import (
    EFFORT,
    LEVELS,
    GroupReader,
    Level,
    TaskChoices,
    check_groups,
    check_scene,
    choose_level,
    presets,
    task_choices,
    to_plain,
)
from neuprim.config.trust import check_stored, refuse_links
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.settings import MetricsSettings
from neuprim.core.used_settings import build_settings
from neuprim.core.validation import format_value, validate
from neuprim.plugins.blame import blamed
from neuprim.plugins.provenance import MadeBy, Maker
from neuprim.plugins.registry import LOSSES, TASKS, FoundScene, PluginInfo, UnknownPlugin, find_scene, load_loss
from neuprim.version import __version__

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

__all__ = ["compose", "compose_all", "preset_settings"]

PATHS = "_paths_"
"""Key of a scene's YAML that lists its settings which are paths: they are made absolute, with ``~`` expanded."""


@dataclass(frozen=True)
class _Request:
    """What one configuration is made of.

    Attributes:
        overrides, assignments: what was typed, as words and as values; the latter without what a resumed run has.
        chosen: task, scene, preset and effort by what was typed or stored; None where nothing says.
        begun: the run that goes on; None for a new one.
        stored: the run of ``--config``.
    """

    overrides: Sequence[str]
    assignments: Sequence[Assignment]
    chosen: Mapping[str, str | None]
    begun: RunConfig | None = None
    stored: RunConfig | None = None

    @property
    def values(self) -> list[Assignment]:
        """What was typed for settings."""
        return [a for a in self.assignments if a.key not in CHOICES]


@dataclass(frozen=True)
class _Choice:
    """Task, scene, preset and level of a configuration, loaded."""

    task_word: str
    scene_word: str
    task_info: PluginInfo
    spec: TaskSpec
    defaults: TaskChoices
    scene: FoundScene
    preset: str
    level: Level | None


@dataclass(frozen=True)
class _Base:
    """Everything below a user's settings, unresolved; ``paths`` are the scene's settings that are paths."""

    tree: dict[str, Any]
    paths: list[str]


def compose(overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None) -> RunConfig:
    """Return the configuration of one run.

    Args:
        overrides: ``key=value`` in Hydra's grammar.
        check_output: refuse an ``output_dir`` that already holds files, unless ``resume=true``.
        stored: an earlier run, whose settings stand under the overrides; the run gets a directory of its own.

    Raises:
        ConfigError: one line that names the key, what was found and what was expected.
    """
    return _compose(overrides, check_output, GroupReader(), stored)


def compose_all(
    overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None
) -> list[RunConfig]:
    """Return the configurations of a sweep, each in its own folder of one output directory, all valid.

    Arguments and errors are those of :func:`compose`.
    """
    swept = set(swept_keys(overrides))
    if not swept:
        return [compose(overrides, check_output, stored)]
    combinations, reader = expand_sweep(overrides), GroupReader()
    # resume=true means the sweep's directory, and each of its runs below
    resume = [word for word in overrides if key_of(word) == "resume"]
    runs = [[word for word in words if key_of(word) != "resume"] for words in combinations]
    configs = [_compose([*words, "output_dir=null"], False, reader, stored) for words in runs]
    first, typed = configs[0], parse(combinations[0])
    goes_on = any(a.value is True for a in parse(resume)[-1:])
    asked = [a.value for a in typed if a.key == "output_dir"]
    explicit = str(_compose(runs[0], False, reader, stored).output_dir) if asked and asked[-1] is not None else None
    choices = [(key, _choice(typed, key) or name) for key, name in (("task", first.task), ("scene", first.scene_name))]
    fixed = [run_name(name, "") for key, name in choices if not swept & {key, "task"}]
    base = output_directory(explicit, "-".join([*fixed, "sweep"]), goes_on, check_output)
    recorded = (base / "sweep.json").is_file()
    made = []
    for config, words, name in zip(configs, runs, sweep_names(overrides, combinations), strict=True):
        place = quote_override("output_dir", str(base / name))
        begun = was_begun_with(base / name, words) if goes_on else None
        if begun is True or (begun is False and not recorded):  # else the sweep's record refuses other words
            config = _compose([*words, "resume=true", place], False, reader, stored)
        own = [*(word for word in config.overrides if key_of(word) != "resume"), *resume]
        own = [word for word in own if word not in ("output_dir=null", place)]
        made.append(dataclasses.replace(config, output_dir=base / name, resume=goes_on, overrides=own))
    return made


def preset_settings(spec: TaskSpec, preset: str, scene: str, level: Level | None = None) -> RunSettings:
    """Return the settings of a preset, or of a level of effort over it; the task need not be registered.

    Raises:
        ConfigError: its files lack something, do not compose, or hold an impossible value.
    """
    check_groups(spec)
    base = _read_base(spec, scene, preset, {}, spec.config_package, GroupReader())
    return _validate_settings(_merge(base.tree, [], () if level is None else level.settings)[1])


def _compose(overrides: Sequence[str], check_output: bool, reader: GroupReader, stored: RunConfig | None) -> RunConfig:
    assignments = parse(overrides)
    chosen = {key: _choice(assignments, key) for key in CHOICES}
    try:
        request = _read_request(overrides, assignments, chosen, stored)
        return _make_config(request, _load_choice(request.chosen), check_output, reader)
    except UnknownPlugin as error:
        explained = explain_missing_plugin(assignments, chosen["task"], chosen["scene"])
        if explained is None:
            raise
        raise explained from error


def _choice(assignments: Sequence[Assignment], key: str) -> str | None:
    """Return what was typed for a choice; None where nothing was."""
    given = [a for a in assignments if a.key == key]
    if not given or given[-1].value is None:
        return None
    value = given[-1].value
    if not isinstance(value, (str, int, float)) or isinstance(value, bool) or not str(value):
        expected = (
            f"a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)" if key == EFFORT else f"the name of a {key}"
        )
        raise ConfigError(f"{given[-1].text}: expected {expected}")
    return str(value)


def _read_request(
    overrides: Sequence[str],
    assignments: Sequence[Assignment],
    chosen: Mapping[str, str | None],
    stored: RunConfig | None,
) -> _Request:
    """Find the run that goes on, and check what a stored configuration may reach."""
    begun = find_resumed_run(assignments, chosen, stored is not None)
    typed = {a.key: a.value for a in assignments}
    if begun is not None:
        assert begun.source is not None, "it was read from its directory"
        new = parse(changed_overrides(begun, overrides) if stored is None else overrides)
        refuse_links(begun.source.parent)
        check_stored(begun, typed)
        return _Request(overrides, new, {**resume_choices(begun, chosen), EFFORT: _choice(new, EFFORT)}, begun, stored)
    if stored is not None:
        check_stored(stored, typed)
        chosen = stored_choices(stored, chosen)
    return _Request(overrides, assignments, chosen, None, stored)


def _load_choice(chosen: Mapping[str, str | None]) -> _Choice:
    """Load the task, and find its scene, preset and level."""
    task_word = chosen["task"] or DEFAULT_TASK
    info, spec = TASKS.loaded(task_word)
    check_groups(spec)
    defaults, names = task_choices(spec), presets(spec)
    level = choose_level(spec, chosen[EFFORT], chosen["preset"], names)
    preset = chosen["preset"] or (defaults.preset if level is None else level.preset)
    scene_word = chosen["scene"] or defaults.scene
    scene = find_scene(spec, scene_word)
    check_scene(spec, scene.spec.name, scene.config_package)
    if preset not in names:
        raise ConfigError(f"preset={preset}: task {spec.name!r} has no such preset{nearest(preset, names)}")
    return _Choice(task_word, scene_word, info, spec, defaults, scene, preset, level)


def _make_config(request: _Request, choice: _Choice, check_output: bool, reader: GroupReader) -> RunConfig:
    spec, scene_name, values = choice.spec, choice.scene.spec.name, request.values
    base = _read_base(spec, scene_name, choice.preset, choice.defaults.options, choice.scene.config_package, reader)
    below = _settings_below(request, choice)
    for assignment in (*below, *values):
        check_key(assignment, base.tree, scene_name)
    plain, full = _merge(base.tree, values, below)
    settings = _validate_settings(full)
    loss = None if settings.train.loss is None else LOSSES.loaded(settings.train.loss)
    declared = None if loss is None else loss[1]
    check_typed(spec, declared, values)
    options = _complete_options(choice, declared, plain, full)
    check_names(spec, settings)
    with blamed(choice.task_info, f"check of task {spec.name!r}"):
        spec.check(build_settings(spec, settings.model, options))
    full["scene"] = _validate_scene(full["scene"], base.tree["scene"], base.paths)
    if settings.metrics.lpips is not None:
        settings.metrics = MetricsSettings(str(Path(settings.metrics.lpips).expanduser().absolute()))
    changed = differences(_flatten_typed(plain), _flatten_typed(full, settings))
    if choice.preset != choice.defaults.preset:
        changed = {"preset": (choice.defaults.preset, choice.preset), **changed}
    name = run_name(choice.task_word, choice.scene_word)
    before = request.begun or request.stored
    made = RunConfig(
        task=spec.name,
        scene_name=scene_name,
        scene=full["scene"],
        preset=choice.preset,
        model=settings.model,
        train=settings.train,
        renderer=settings.renderer,
        metrics=settings.metrics,
        output_dir=output_directory(settings.output_dir, name, settings.resume, check_output),
        seed=settings.seed,
        resume=settings.resume,
        options=options,
        unused=unused_settings(spec, declared),
        overrides=list(request.overrides) if before is None else merge_overrides(before, request.overrides),
        non_default=changed,
        made_by=_record_makers(choice, loss),
    )
    if request.begun is not None:
        refuse_contradictions(request.begun, made, base.paths)
    return made


def _settings_below(request: _Request, choice: _Choice) -> list[Assignment]:
    """Return what stands under the typed settings: of the run that goes on, of ``--config`` and of the level."""
    values, below = request.values, []
    if request.begun is not None:
        skipped = launch_settings(request.overrides)
        below += [a for a in stored_assignments(request.begun, choice.scene_word, values) if a.key not in skipped]
    if request.stored is not None:
        below += stored_assignments(request.stored, choice.scene_word, values)
    return below + ([] if choice.level is None else list(choice.level.settings))


def _record_makers(choice: _Choice, loss: tuple[PluginInfo, LossExtension] | None) -> MadeBy:
    added = choice.scene.added_by
    scene = None if added is None else Maker.of(added, choice.scene.spec.name)
    return MadeBy(__version__, Maker.of(choice.task_info), scene, None if loss is None else Maker.of(loss[0]))


# ---------------------------------------------------------------- merging


def _read_base(
    spec: TaskSpec, scene: str, preset: str, options: dict[str, Any], package: str, reader: GroupReader
) -> _Base:
    """Merge defaults, preset and scene; a scene of another ``package`` cannot replace a preset of the task."""
    from omegaconf import OmegaConf

    scene_node = reader.read_scene(spec, scene, package)
    preset_node, common = reader.read_preset(spec, preset)
    place, scene_place = f"preset/{spec.name}/{preset}.yaml", f"scene/{spec.name}/{scene}.yaml"
    for key in preset_node:
        if key not in GROUPS:
            raise ConfigError(f"{place}: {key}: a preset may only set {', '.join(GROUPS)}")
    paths = scene_node.pop(PATHS, None) or []
    if not isinstance(paths, list) or any(name not in scene_node for name in paths) or "name" in scene_node:
        raise ConfigError(f"{scene_place}: {PATHS} must list keys of the file, and name is no setting")
    merged = OmegaConf.merge(dataclasses.asdict(RunSettings()), common, preset_node)
    tree = {**to_plain(merged, resolve=False), "scene": scene_node, "task": {"options": options}}
    try:
        loss = _validate_settings(to_plain(OmegaConf.create(tree))).train.loss
        check_preset(spec, None if loss is None else load_loss(loss), preset_node)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from error
    return _Base(tree, paths)


def _merge(
    base: Mapping[str, Any], values: Sequence[Assignment], below: Sequence[Assignment] = ()
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the resolved configuration without and with the user's ``values``, which stand over ``below``."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    tree = OmegaConf.create(copy.deepcopy(dict(base)))
    if _chooses_other_form(base, values):
        OmegaConf.update(tree, "model.density", {}, merge=False)
    for a in (*below, *values):
        value = hide_references(a.value) if a.whole else a.value
        try:
            OmegaConf.update(tree, a.key, value, merge=not a.whole, force_add=True)
        except (OmegaConfBaseException, ValueError, TypeError, AssertionError) as error:
            raise ConfigError(f"{a.text}: {' '.join(str(error).split())}") from error
    seconds = _typed_values(values, "max_seconds")
    if seconds and seconds[-1] is not None and not _typed_values(values, "iterations"):
        OmegaConf.update(tree, "train.iterations", None)  # a budget in seconds is used up, however fast the machine
    strategy = _typed_values(values, "strategy", "train.population")
    other = bool(strategy) and strategy[-1] != base["train"]["population"]["strategy"]
    if other and not _typed_values(values, "grow_from", "train.population"):
        OmegaConf.update(tree, "train.population.grow_from", 1.0)  # the preset's is for populations that grow that way
    return to_plain(OmegaConf.create(dict(base))), hide_references(to_plain(tree), back=True)


def _typed_values(values: Sequence[Assignment], name: str, group: str = "train") -> list[Any]:
    """Return what was typed for a setting of a group, alone or within the group, in order."""
    whole = [{name: a.value} if a.key == f"{group}.{name}" else a.value if a.key == group else {} for a in values]
    return [given[name] for given in whole if isinstance(given, Mapping) and name in given]


def _chooses_other_form(base: Mapping[str, Any], values: Sequence[Assignment]) -> bool:
    """Whether another form of density was typed than the preset's, whose settings would mean nothing to it."""
    own = (base["model"].get("density") or {}).get("form")
    typed = _typed_values(values, "form", "model.density")
    return own is not None and bool(typed) and typed[-1] not in (None, own)


# ---------------------------------------------------------------- validating


def _validate_settings(full: Mapping[str, Any]) -> RunSettings:
    return validate(RunSettings, {key: value for key, value in full.items() if key not in ("scene", "task")})


def _complete_options(
    choice: _Choice, loss: LossExtension | None, plain: dict[str, Any], full: dict[str, Any]
) -> dict[str, Any]:
    """Return all of ``task.options``; ``plain`` and ``full`` get those without and with the user's values."""
    declared = options_of(choice.spec, loss)
    owner = f"task {choice.spec.name!r}"
    if loss is not None and loss.options:
        owner += f" with loss {loss.name!r}"
    for tree, given in ((plain, choice.defaults.options), (full, full["task"]["options"])):
        tree["task"] = {"options": complete_options(declared, given, owner)}
    options: dict[str, Any] = full["task"]["options"]
    return options


def _validate_scene(node: Mapping[str, Any], declared: Mapping[str, Any], paths: Sequence[str]) -> dict[str, Any]:
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
        result[key] = like_default(value, declared[key], where)
    return result


def _flatten_typed(full: Mapping[str, Any], settings: RunSettings | None = None) -> dict[str, Any]:
    """Return flat dotted values, with the settings in their own types, so that 1 and 1.0 are the same rate."""
    made = dataclasses.asdict(settings or _validate_settings(full))
    tree = {**made, "scene": full["scene"], "task": full["task"]}
    del tree["output_dir"], tree["resume"]
    return flatten(tree)
