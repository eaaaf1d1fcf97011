"""Compose a :class:`RunConfig` from the overrides of ``neuprim run``.

A setting's value comes from the first of these sources that sets it: overrides, the level of effort, a stored run,
the preset, the defaults of the settings dataclasses. Hydra parses the overrides. OmegaConf merges the overrides with
the YAML files and resolves ``${...}``. The settings dataclasses define which keys exist.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.config.overrides import (
    Assignment,
    drop_output_overrides,
    expand_sweep_overrides,
    key_of,
    parse_overrides,
    quote_override,
    sweep_override_names,
    swept_override_keys,
)
from neuprim.config.run_config import RunConfig, RunSettings, flatten, refuse_missing_config_plugins
from neuprim.config.setting_checks import (
    CHOICES,
    check_config_key,
    check_config_parameter_names,
    complete_task_options,
    refuse_unused,
    task_and_loss_options,
    unused_settings,
)
from neuprim.config.stored_run import (
    DEFAULT_TASK,
    config_output_directory,
    config_output_name,
    find_resumed_config,
    refuse_contradictions,
    refuse_untrusted_settings,
    restore_config_references,
    stored_choices,
    stored_settings,
)
from neuprim.config.task_files import (
    EFFORT,
    LEVELS,
    PRESET_GROUPS,
    Level,
    check_config_groups,
    check_scene_config,
    choose_config_effort_level,
    list_task_presets,
    omegaconf_to_plain,
    read_config_group,
    read_task_config,
)
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.settings import MetricsSettings
from neuprim.core.train.process_group import read_torchrun_rank
from neuprim.core.train.settings import build_settings
from neuprim.core.validation import (
    format_setting_value,
    infer_type_to_validate,
    validate_setting_names,
    validate_settings,
    validate_value,
)
from neuprim.plugins.attribution import attribute_errors, find_plugin_source
from neuprim.plugins.provenance import Provenance
from neuprim.plugins.registry import (
    LOSSES,
    TASKS,
    FoundScene,
    PluginInfo,
    UnknownPlugin,
    find_registered_scene,
    qualified_plugin_name,
    split_plugin_name,
)

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

_PATHS = "_paths_"
"""Key in a scene's YAML file that lists the settings which are paths. Paths are made absolute, with ``~`` expanded."""

_REQUIRED = "???"
"""Value, in a scene's YAML file, of a setting that has no default (OmegaConf's mark for a missing value)."""


@dataclass(frozen=True)
class _Selection:
    """Loaded task, scene, preset and level of effort of a configuration, and default ``name`` of the run directory."""

    task_info: PluginInfo
    spec: TaskSpec
    scene: FoundScene
    preset: str
    default_preset: str
    level: Level | None
    name: str
    options: dict[str, Any]


@dataclass(frozen=True)
class _BaseConfig:
    """Settings before overrides apply and ``${...}`` is resolved, and names of the scene settings that hold paths."""

    tree: dict[str, Any]
    paths: list[str]


def compose(overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None) -> RunConfig:
    """Return the configuration of one run.

    Args:
        overrides: ``key=value`` in Hydra's grammar, as after ``neuprim run``.
        check_output: whether to refuse an ``output_dir`` that already holds files, unless ``resume=true``.
        stored: an earlier run whose settings replace the defaults. The new run has its own directory.

    Raises:
        ConfigError: a key or value is wrong. The message is one line: the key, what was found and what was expected.
    """
    assignments = parse_overrides(overrides)
    typed = {a.key: a.value for a in assignments}
    choices: dict[str, str | None] = {key: _read_choice(assignments, key) for key in CHOICES}
    begun = find_resumed_config(typed, choices, stored is not None)
    earlier = [config for config in (begun, stored) if config is not None]
    for config in earlier:
        refuse_untrusted_settings(config, typed)
    # If torchrun's ranks get the overrides that describe a run, these decide how many views each rank has.
    new_launch = begun is not None and read_torchrun_rank() is not None and bool(choices["task"] or choices["scene"])
    if begun is not None:
        choices = stored_choices(begun, choices, resumed=True)
    elif stored is not None:
        choices = stored_choices(stored, choices)
    values = [a for a in assignments if a.key not in CHOICES]
    try:
        config, paths = _compose_run_config(
            _select_task_scene_and_preset(choices), values, earlier, check_output, new_launch
        )
    except UnknownPlugin:
        if begun is not None:
            refuse_missing_config_plugins(begun)  # the error that names the package is more helpful
        raise
    if begun is not None:
        if config.model.primitives == "auto":  # typed again: the run stored the number
            config.model = dataclasses.replace(config.model, primitives=begun.model.primitives)
        refuse_contradictions(begun, config, paths)
    config.model = config.model.with_count_for(config.train)
    config.overrides = _merge_overrides(earlier[0], overrides) if earlier else list(overrides)
    return config


def compose_all(
    overrides: Sequence[str], check_output: bool = True, stored: RunConfig | None = None
) -> list[RunConfig]:
    """Return the configurations of all runs of a sweep, each with its own directory in the sweep's directory.

    A sweep has one run for each combination of values, e.g. for ``seed=0,1``. Arguments: see :func:`compose`.
    """
    swept = set(swept_override_keys(overrides))
    if not swept:
        return [compose(overrides, check_output, stored)]
    combinations = expand_sweep_overrides(overrides)
    place = {
        a.key: a for a in parse_overrides([text for text in overrides if key_of(text) in ("output_dir", "resume")])
    }
    resume = "resume" in place and place["resume"].value is True
    asked = place["output_dir"].text if "output_dir" in place and place["output_dir"].value is not None else None
    first = compose([*drop_output_overrides(combinations[0]), *([] if asked is None else [asked])], False, stored)
    typed = parse_overrides(combinations[0])
    names = [("task", first.task), ("scene", first.scene_name)]
    fixed = [
        config_output_name(_read_choice(typed, key) or name, "") for key, name in names if not swept & {key, "task"}
    ]
    explicit = None if asked is None else str(first.output_dir)
    folder = config_output_directory(explicit, "-".join([*fixed, "sweep"]), resume, check_output)
    made = []
    for texts, name in zip(combinations, sweep_override_names(overrides, combinations), strict=True):
        own = drop_output_overrides(texts)
        directory = folder / name
        goes_on = resume and _uses_own_stored_config(directory, own, (folder / "sweep.json").is_file())
        output_dir = quote_override("output_dir", str(directory))
        config = compose([*own, output_dir, *(["resume=true"] if goes_on else [])], False, stored)
        typed_now = [text for text in config.overrides if text not in (output_dir, "resume=true")]
        typed_now += [a.text for a in place.values()]
        made.append(dataclasses.replace(config, resume=resume, overrides=typed_now))
    return made


def _uses_own_stored_config(directory: Path, own: Sequence[str], recorded: bool) -> bool:
    """Return whether a run of a resumed sweep starts from the ``config.yaml`` in its directory.

    If the sweep has a record (``recorded``), the stored overrides must equal ``own``, the overrides of the run now,
    without output directory and ``resume``. Different overrides are refused later, by comparison with the record.
    """
    if not (directory / "config.yaml").is_file():
        return False
    return not recorded or drop_output_overrides(RunConfig.from_yaml(directory).overrides) == list(own)


def preset_settings(spec: TaskSpec, preset: str, scene: str, level: Level | None = None) -> RunSettings:
    """Return the settings of a preset, changed by a level of effort if one is given. The task need not be registered.

    Raises:
        ConfigError: a YAML file of the task is incomplete, cannot be read, or has an invalid value.
    """
    check_config_groups(spec)
    base = _read_base(spec, scene, spec.config_package, preset, {})
    for assignment in level.settings if level is not None else ():
        check_config_key(assignment, base.tree["scene"], scene)
    return _validate_settings(_resolve_config(base, {}, level))


def _read_choice(assignments: Sequence[Assignment], key: str) -> str | None:
    """Return the last value typed for ``key`` (task, scene, preset or effort) as text; None if there is none."""
    given = [a for a in assignments if a.key == key]
    if not given or given[-1].value is None:
        return None
    value = given[-1].value
    if not isinstance(value, (str, int, float)) or isinstance(value, bool) or not str(value):
        level = f"a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)"
        raise ConfigError(f"{given[-1].text}: expected {level if key == EFFORT else f'the name of a {key}'}")
    return str(value)


def _select_task_scene_and_preset(choices: Mapping[str, str | None]) -> _Selection:
    """Load the chosen task, and find its scene, preset and level of effort; choices that are None take the defaults."""
    task_name = choices["task"] or DEFAULT_TASK
    info, spec = TASKS.load_with_info(task_name)
    check_config_groups(spec)
    defaults, names = read_task_config(spec), list_task_presets(spec)
    level = choose_config_effort_level(spec, choices[EFFORT], choices["preset"], names)
    preset = choices["preset"] or (defaults.preset if level is None else level.preset)
    scene_name = choices["scene"] or defaults.scene
    scene = find_registered_scene(spec, scene_name)
    check_scene_config(spec, scene.spec.name, scene.config_package)
    if preset not in names:
        raise ConfigError(f"preset={preset}: task {spec.name!r} has no such preset{nearest(preset, names)}")
    name = config_output_name(task_name, scene_name)
    return _Selection(info, spec, scene, preset, defaults.preset, level, name, defaults.options)


def _compose_run_config(
    chosen: _Selection,
    values: Sequence[Assignment],
    earlier: Sequence[RunConfig],
    check_output: bool,
    new_launch: bool = False,
) -> tuple[RunConfig, list[str]]:
    """Return a validated configuration, and the names of the scene settings that are paths.

    The field ``overrides`` of the configuration is not set yet.

    Args:
        values: overrides, except those that choose task, scene, preset and effort.
        earlier: stored runs, whose settings replace the defaults.
        new_launch: whether torchrun resumes the run with the arguments of a new run. Then the stored value of
            ``train.views_per_step`` is not used.
    """
    spec, scene = chosen.spec, chosen.scene
    base = _read_base(spec, scene.spec.name, scene.config_package, chosen.preset, chosen.options)
    declared = base.tree["scene"]
    for assignment in (*(() if chosen.level is None else chosen.level.settings), *values):
        check_config_key(assignment, declared, scene.spec.name)
    below: dict[str, Any] = {}
    for config in earlier:
        same_scene = scene.spec.name == split_plugin_name(config.scene_name)[1]
        below |= stored_settings(config, same_scene)
        if same_scene:
            validate_setting_names(config.scene, declared, "scene")
    if new_launch:
        below["train"]["views_per_step"] = base.tree["train"]["views_per_step"]
    plain = _resolve_config(base, {})
    full = _resolve_config(base, below, chosen.level, values)
    settings = _validate_settings(full)
    loss_info, loss = (None, None) if settings.train.loss is None else LOSSES.load_with_info(settings.train.loss)
    refuse_unused(flatten({a.key: a.value for a in values}), spec, loss)
    available = task_and_loss_options(spec, loss)
    owner = f"task {spec.name!r}" + (f" with loss {loss.name!r}" if loss is not None and loss.options else "")
    for tree in (plain, full):
        tree["task"]["options"] = complete_task_options(available, tree["task"]["options"], owner)
    options = full["task"]["options"]
    check_config_parameter_names(spec, settings)
    source = find_plugin_source(TASKS, qualified_plugin_name(chosen.task_info.distribution, spec.name))
    with attribute_errors(source, "check"):
        spec.check(build_settings(spec, settings.model, options))
    full["scene"] = _validate_scene(full["scene"], declared, base.paths)
    if settings.metrics.lpips is not None:
        settings.metrics = MetricsSettings(str(Path(settings.metrics.lpips).expanduser().absolute()))
    preset = {"preset": (chosen.default_preset, chosen.preset)} if chosen.preset != chosen.default_preset else {}
    config = RunConfig(
        task=spec.name,
        scene_name=scene.spec.name,
        scene=full["scene"],
        preset=chosen.preset,
        output_dir=config_output_directory(settings.output_dir, chosen.name, settings.resume, check_output),
        options=options,
        unused=unused_settings(spec, loss),
        non_default=preset
        | _find_non_default_config(
            _flatten_config_settings(plain, _validate_settings(plain)), _flatten_config_settings(full, settings)
        ),
        made_by=Provenance.of_installed(chosen.task_info, scene, loss_info),
        **{name: getattr(settings, name) for name in ("model", "train", "renderer", "metrics", "seed", "resume")},
    )
    return config, base.paths


def _merge_overrides(earlier: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Return all overrides typed for a run so far, in earlier commands and now. A later value of a key replaces an
    earlier one.
    """
    again = {key_of(text) for text in overrides}
    return [*(text for text in drop_output_overrides(earlier.overrides) if key_of(text) not in again), *overrides]


# ---------------------------------------------------------------- merging


def _read_base(spec: TaskSpec, scene: str, package: str, preset: str, options: dict[str, Any]) -> _BaseConfig:
    """Return the merged settings of defaults, preset and scene. ``package`` has the scene's YAML file."""
    from omegaconf import OmegaConf

    scene_node, preset_node = (
        read_config_group(spec, "scene", scene, package),
        read_config_group(spec, "preset", preset),
    )
    place = f"preset/{spec.name}/{preset}.yaml"
    for name, value in (preset_node.pop("scene", None) or {}).items():
        if name not in scene_node or name == _PATHS:
            raise ConfigError(f"preset={preset}: the preset sets scene.{name}, which scene={scene} does not have")
        scene_node[name] = value
    for key in preset_node:
        if key not in PRESET_GROUPS:
            raise ConfigError(f"{place}: {key}: a preset may only set scene, {', '.join(PRESET_GROUPS)}")
    paths = scene_node.pop(_PATHS, None) or []
    if not isinstance(paths, list) or any(name not in scene_node for name in paths) or "name" in scene_node:
        raise ConfigError(
            f"scene/{spec.name}/{scene}.yaml: {_PATHS} may only list keys of the file, "
            "and the file must have no key 'name'"
        )
    merged = OmegaConf.merge(dataclasses.asdict(RunSettings()), preset_node)
    base = _BaseConfig(
        {**omegaconf_to_plain(merged, resolve=False), "scene": scene_node, "task": {"options": options}}, paths
    )
    try:
        loss = _validate_settings(_resolve_config(base, {})).train.loss
        # while another loss is chosen, a preset may also set settings that the task's own loss reads
        unused = unused_settings(spec, None if loss is None else LOSSES.load(loss))
        refuse_unused([name for name in flatten(preset_node) if name in unused], spec, None)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from error
    return base


def _resolve_config(
    base: _BaseConfig, earlier: Mapping[str, Any], level: Level | None = None, values: Sequence[Assignment] = ()
) -> dict[str, Any]:
    """Return the configuration as nested values, with ``${...}`` resolved.

    Values come from four sources: ``base``, ``earlier`` runs, ``level``, overrides (``values``). A later source
    replaces values of an earlier source.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    tree = OmegaConf.create(base.tree)
    for key, value in earlier.items():
        OmegaConf.update(tree, key, value, merge=False, force_add=True)
    form, strategy = (
        _find_typed_value(values, "model.density", "form"),
        _find_typed_value(values, "train.population", "strategy"),
    )
    if form is not None and tree.model.density.get("form", None if earlier else form) != form:
        OmegaConf.update(tree, "model.density", {}, merge=False)  # settings of another form mean nothing to it
    colour, before = _find_typed_value(values, "model.colour", "form"), tree.model.colour.get("form")
    if colour is not None and colour != before:
        tree.model.colour.pop(str(before), None)  # a form's own settings have its name
    other_strategy = strategy is not None and tree.train.population.strategy != strategy
    for a in (*(() if level is None else level.settings), *values):
        try:
            OmegaConf.update(tree, a.key, a.value, force_add=True)
        except (OmegaConfBaseException, ValueError, TypeError, AssertionError) as error:
            raise ConfigError(f"{a.text}: {' '.join(str(error).split())}") from error
    seconds, steps = _find_typed_value(values, "train", "max_seconds"), _find_typed_value(values, "train", "iterations")
    if seconds is not None and steps is None:
        OmegaConf.update(tree, "train.iterations", None)  # a budget in seconds is used up, however fast the machine
    if steps is not None and seconds is None and earlier:
        OmegaConf.update(tree, "train.max_seconds", None)  # it was the budget of the earlier run
    if other_strategy and _find_typed_value(values, "train.population", "grow_from") is None:
        OmegaConf.update(tree, "train.population.grow_from", 1.0)  # the preset's value is for its own strategy
    plain: dict[str, Any] = restore_config_references(omegaconf_to_plain(tree))
    return plain


def _find_typed_value(values: Sequence[Assignment], group: str, name: str) -> Any:
    """Return the last value typed for a group's setting ``name``, as ``group.name=VALUE`` or in ``group={...}``."""
    found = None
    for a in values:
        if a.key == f"{group}.{name}":
            found = a.value
        elif a.key == group and isinstance(a.value, Mapping) and name in a.value:
            found = a.value[name]
    return found


# ---------------------------------------------------------------- validating


def _validate_settings(tree: Mapping[str, Any]) -> RunSettings:
    return validate_settings(RunSettings, {key: value for key, value in tree.items() if key not in ("scene", "task")})


def _validate_scene(node: Mapping[str, Any], declared: Mapping[str, Any], paths: Sequence[str]) -> dict[str, Any]:
    """Return a scene's settings, each converted to the type of its default. A setting whose default is null or required
    accepts any value.
    """
    result: dict[str, Any] = {}
    for key, value in node.items():
        where, default = f"scene.{key}", declared[key]
        if default == _REQUIRED and value in (None, _REQUIRED):
            expected = f"{where}=PATH, a directory or file" if key in paths else f"{where}=VALUE"
            raise ConfigError(f"{where}: required and not given; expected {expected}")
        if key in paths and value is not None:
            if not isinstance(value, (str, int)) or isinstance(value, bool) or not str(value).strip():
                raise ConfigError(f"{where}={format_setting_value(value)}: expected a path (quote it: {where}='...')")
            value = str(value) if "://" in str(value) else str(Path(str(value)).expanduser().absolute())
        result[key] = value if default == _REQUIRED else validate_value(value, infer_type_to_validate(default), where)
    return result


def _flatten_config_settings(tree: Mapping[str, Any], settings: RunSettings) -> dict[str, Any]:
    """Return dotted key -> value of all settings, except ``output_dir`` and ``resume``.

    Scene settings and task options come from the nested ``tree``. All others come from ``settings``, whose classes
    have converted the values, e.g. a rate of 1 to 1.0.
    """
    values = {**dataclasses.asdict(settings), "scene": tree["scene"], "task": tree["task"]}
    return flatten({key: value for key, value in values.items() if key not in ("output_dir", "resume")})


def _find_non_default_config(default: Mapping[str, Any], actual: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return key -> (default, value) for flat settings whose value differs from the default."""
    before = {key: None if value == _REQUIRED else value for key, value in default.items()}
    pairs = {key: (before.get(key), actual.get(key)) for key in {**default, **actual}}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
