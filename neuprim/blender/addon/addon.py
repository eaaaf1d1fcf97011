"""Blender add-on: fit a model to an OpenVDB sequence, show it in place, and render it with the scene's camera.

This file runs in Blender's Python, which has neither torch nor neuprim. The add-on therefore starts neuprim in the
Python environment of its preferences, and reads the lines that neuprim prints.
"""

import atexit
import json
import os
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, PointerProperty, StringProperty
from mathutils import Matrix, Vector

from .job import InputError, Job

RUN, LIT = "neuprim_run", "neuprim_lit"
"""Properties of a volume object that shows a model: the run directory, and whether the model can be lit."""

INSTALLATION = Path(__file__).with_name("installation.json")  # written when the .zip file is built
SUN_DISTANCE = 1000.0  # diagonals of the volume's box: rays of the sun are parallel
TOLERANCE = 1e-4  # relative, of scales and angles in an object's matrix


# ---------------------------------------------------------------- the job that runs

_job: Job | None = None
_message, _failed = "", False


def start(operator: bpy.types.Operator, job: Job) -> set[str]:
    """Let Blender's user interface follow ``job``; without a user interface, wait for its end."""
    global _job, _message
    if not bpy.app.background:
        _job, _message = job, ""
        bpy.app.timers.register(_follow, first_interval=0.2, persistent=True)  # even if another file is opened
        return {"FINISHED"}
    job.wait()
    try:
        operator.report({"INFO"}, job.finish())
    except InputError as error:
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    return {"FINISHED"}


def _follow() -> float | None:
    """Redraw the panel while the job runs, then finish it; Blender calls this every 0.3 seconds until it is None."""
    global _job, _message, _failed
    if _job is not None and not _job.running:
        done, _job = _job, None
        try:
            _message, _failed = done.finish(), False
        except InputError as error:
            _message, _failed = str(error), True
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
    return None if _job is None else 0.3


@atexit.register
def _cancel_job() -> None:
    if _job is not None:
        _job.cancel()


def neuprim(context: bpy.types.Context, *words: object) -> list[str]:
    """Return the command line that runs ``neuprim`` with these arguments."""
    python = context.preferences.addons[__package__].preferences.python
    if not os.path.isfile(python):
        raise InputError(
            f"{python or 'no file'}: not found; set the Python of neuprim in the preferences of the add-on"
        )
    return [python, "-m", "neuprim", *map(str, words)]


# ---------------------------------------------------------------- fit


def fit(context: bpy.types.Context, resume: bool) -> Job:
    """Fit a model to the sequence of the active volume object, and export it as OpenVDB files.

    ``resume`` continues an interrupted fit.
    """
    source, settings = context.object, context.scene.neuprim
    if source is None or source.type != "VOLUME" or not source.data.filepath or RUN in source:
        raise InputError("no OpenVDB sequence is selected; select one, or add it with Add > Volume > Import OpenVDB")
    path = Path(bpy.path.abspath(source.data.filepath))
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    quoted = str(path).replace("\\", "\\\\").replace("'", "\\'")
    words = ["task=dynamic", "scene=vdb", f"scene.vdb='{quoted}'", f"scene.up={upward_axis(source)}"]
    if source.data.is_sequence:
        first = source.data.frame_offset + 1
        words.append(f"scene.frames={first}:{first + source.data.frame_duration - 1}")
    words += ["preset=preview"] if settings.preset == "preview" else ["scene.lights=4"] if settings.lit else []
    words += shlex.split(settings.extra)
    lit = any(re.fullmatch(r"scene\.lights=(?!1$)\d+", word) for word in words)
    if settings.folder.startswith("//") and not bpy.data.is_saved:
        raise InputError("save the .blend file first, or choose a folder for the models")
    run = choose_run_directory(Path(bpy.path.abspath(settings.folder)), source.name, resume)
    words += ["resume=true"] if resume else []
    commands = [
        neuprim(context, "run", *words, "--out", run),
        neuprim(context, "export", run, "--format", "vdb", "--force"),
    ]
    name = source.name

    def finish(job: Job) -> str:
        job.check()
        files = [file for file in job.files[1] if file.suffix == ".vdb"]
        if name not in bpy.data.objects:
            raise InputError(f"{name} is gone; its model is in {run}")
        show_model(bpy.data.objects[name], run, files[0], lit)
        return f"{fit_summary(run)}; report: {run / 'report.html'}"

    return Job(f"fit {name}", commands, finish)


def upward_axis(source: bpy.types.Object) -> str:
    """Return y or z: the axis of the files that points up in the scene, as far as these two can."""
    up = rigid_inverse(source).to_3x3() @ Vector((0, 0, 1))
    return "y" if abs(up.y) > abs(up.z) else "z"


def choose_run_directory(folder: Path, name: str, resume: bool) -> Path:
    """Return a new directory for a run, or with ``resume`` the newest one, whose fit was interrupted."""
    stem, number = folder / file_stem(name), 1
    newest, run = None, stem
    while run.exists():
        number += 1
        newest, run = run, stem.with_name(f"{stem.name}_{number}")
    if not resume:
        return run
    if newest is None or not (newest / "checkpoint.safetensors").exists() or (newest / "export").exists():
        raise InputError(f"{folder}: no interrupted fit of {name}")
    return newest


def file_stem(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)


def fit_summary(run: Path) -> str:
    psnr = json.loads((run / "metrics.json").read_text(encoding="utf-8"))["psnr"]
    return f"held-out images: {psnr:.1f} dB"


def show_model(source: bpy.types.Object, run: Path, file: Path, lit: bool) -> None:
    """Add a volume object with the exported files at the place of ``source``, which is hidden."""
    data = bpy.data.volumes.new(f"{source.name} model")
    data.filepath = str(file)
    data.is_sequence = source.data.is_sequence
    for name in ("frame_start", "frame_offset", "frame_duration", "sequence_mode"):
        setattr(data, name, getattr(source.data, name))
    for material in source.data.materials:
        data.materials.append(material)
    shown = bpy.data.objects.new(data.name, data)
    shown.parent = source  # follows it, also when it is animated
    shown[RUN], shown[LIT] = str(run), lit
    for collection in source.users_collection:
        collection.objects.link(shown)
    source.hide_render = source.hide_viewport = True


# ---------------------------------------------------------------- render


def render(context: bpy.types.Context, animation: bool) -> Job:
    """Render a model with the scene's camera as OpenEXR files with layers, one per frame."""
    scene, shown = context.scene, find_model(context)
    run, name = Path(shown[RUN]), shown.name
    if not run.is_dir():
        raise InputError(f"{run}: no such run directory; fit {name} again")
    before = scene.frame_current
    frames = range(scene.frame_start, scene.frame_end + 1, scene.frame_step) if animation else [before]
    try:
        shots = list(read_shots(context, shown, frames))
    finally:
        scene.frame_set(before)
    if not shots:
        raise InputError(f"{name} has no file at frame {frames[0]}" + (f" to {frames[-1]}" if animation else ""))
    folder = run / "blender"
    folder.mkdir(exist_ok=True)
    parts = Path(tempfile.mkdtemp(prefix=".rendering-", dir=folder))
    commands, groups = [], group_shots(shots)
    for k, group in enumerate(groups):
        cameras = parts / f"{k}.json"
        file = {**group[0]["size"], "fps": scene.render.fps / scene.render.fps_base}
        cameras.write_text(json.dumps({**file, "frames": [shot["view"] for shot in group]}), encoding="utf-8")
        words = ["--camera", cameras, "--format", "exr", "--out", parts / str(k), *group[0]["flags"]]
        if shown.data.is_sequence:
            words += ["--frame", ",".join(str(shot["number"]) for shot in group)]
        commands.append(neuprim(context, "render", run, *words))

    def finish(job: Job) -> str:
        targets = []
        for k, group in enumerate(groups):  # also those of a render that was cancelled
            for file, shot in zip(sorted((parts / str(k)).glob("*.exr"), key=last_number), group, strict=False):
                targets.append(folder / f"{file_stem(name)}.{shot['frame']:04d}.exr")
                os.replace(file, targets[-1])
        shutil.rmtree(parts)
        job.check()
        image = bpy.data.images.load(str(targets[0]), check_existing=True)
        image.source = "SEQUENCE" if len(targets) > 1 else "FILE"
        image.reload()
        return f"{targets[0]}" + (f" to {targets[-1].name}" if len(targets) > 1 else "")

    return Job(f"render {name}", commands, finish)


def last_number(file: Path) -> int:
    return int(re.findall(r"\d+", file.stem)[-1])


def find_model(context: bpy.types.Context) -> bpy.types.Object:
    """Return the active object if it shows a model, otherwise the only object of the scene that does."""
    if context.object is not None and RUN in context.object:
        return context.object
    found = [shown for shown in context.scene.objects if RUN in shown]
    if len(found) != 1:
        raise InputError("select a model of neuprim" if found else "no model of neuprim in this scene; fit one first")
    return found[0]


def read_shots(context: bpy.types.Context, shown: bpy.types.Object, frames: Iterable[int]) -> Iterator[dict]:
    """Yield what neuprim needs for each of the frames at which ``shown`` has a file: camera, file number and flags."""
    scene, render = context.scene, context.scene.render
    w, h = (round(side * render.resolution_percentage / 100) for side in (render.resolution_x, render.resolution_y))
    for frame in frames:
        scene.frame_set(frame)
        number = file_number(shown.data, frame)
        if number is None:
            continue
        if scene.camera is None or scene.camera.data.type != "PERSP":
            raise InputError(f"frame {frame}: expected a perspective camera")
        depsgraph = context.evaluated_depsgraph_get()
        camera, place = scene.camera.evaluated_get(depsgraph), rigid_inverse(shown.evaluated_get(depsgraph))
        P = camera.calc_matrix_camera(depsgraph, x=w, y=h, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y)
        pose = (place @ camera.matrix_world).normalized()
        flags = light_flags(scene, shown, place) if shown[LIT] else []
        if render.use_motion_blur:
            flags += ["--shutter", f"{min(render.motion_blur_shutter, 1.0):.6g}"]
        yield {
            "frame": frame,
            "number": number,
            "flags": flags,
            "size": {"w": w, "h": h},
            "view": {
                "transform_matrix": [list(row) for row in pose],
                "fl_x": P[0][0] * w / 2,
                "fl_y": P[1][1] * h / 2,
                "cx": (1 - P[0][2]) * w / 2,
                "cy": (1 + P[1][2]) * h / 2,
            },
        }


def file_number(volume: bpy.types.Volume, frame: int) -> int | None:
    """Return the number of the file that Blender shows at ``frame``; None if it shows none."""
    if not volume.is_sequence:
        return 0
    index, count, mode = frame - volume.frame_start, volume.frame_duration, volume.sequence_mode
    if mode == "EXTEND":
        index = min(max(index, 0), count - 1)
    elif mode == "REPEAT":
        index %= count
    elif mode == "PING_PONG":
        index %= max(2 * count - 2, 1)
        index = min(index, 2 * count - 2 - index)
    return index + 1 + volume.frame_offset if 0 <= index < count else None


def group_shots(shots: list[dict]) -> list[list[dict]]:
    """Divide shots into groups that one command can render: equal flags, and ascending numbers of files."""
    groups: list[list[dict]] = []
    for shot in shots:
        last = groups[-1][-1] if groups else None
        if last is not None and last["flags"] == shot["flags"] and last["number"] < shot["number"]:
            groups[-1].append(shot)
        else:
            groups.append([shot])
    return groups


def light_flags(scene: bpy.types.Scene, shown: bpy.types.Object, place: Matrix) -> list[str]:
    """Return the flags that light a model by the sun of the scene; ``place`` maps the scene to the files."""
    suns = [lamp for lamp in scene.objects if lamp.type == "LIGHT" and lamp.data.type == "SUN" and not lamp.hide_render]
    if len(suns) != 1:
        raise InputError(f"{len(suns)} suns light the scene; {shown.name} needs exactly one")
    shown.data.grids.load()  # without them, the box is unknown
    corners = [Vector(corner) for corner in shown.bound_box]
    center, diagonal = sum(corners, Vector()) / 8, (corners[6] - corners[0]).length
    towards = (place.to_3x3() @ suns[0].matrix_world.to_3x3().col[2]).normalized()
    position = center + SUN_DISTANCE * diagonal * towards
    strength = suns[0].data.energy * Vector(suns[0].data.color)
    return ["--light", ",".join(map(repr, position)), "--light-intensity", ",".join(map(repr, strength))]


def rigid_inverse(shown: bpy.types.Object) -> Matrix:
    """Return the matrix from the scene to the coordinates of the object's files.

    Raises:
        InputError: the object is mirrored, sheared or scaled differently along its axes.
    """
    turn = shown.matrix_world.to_3x3()
    scale = turn.col[0].length
    gram = turn.transposed() @ turn
    square = scale * scale * Matrix.Identity(3)
    if max(abs(x) for row in gram - square for x in row) > TOLERANCE * scale * scale or turn.determinant() <= 0:
        raise InputError(f"{shown.name}: mirrored, sheared or with unequal scales; expected a uniform scale")
    return shown.matrix_world.inverted()


# ---------------------------------------------------------------- user interface


class NeuprimPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    python: StringProperty(
        name="Python of neuprim",
        description="Python of the environment in which neuprim is installed",
        subtype="FILE_PATH",
        default=json.loads(INSTALLATION.read_text(encoding="utf-8"))["python"],
    )

    def draw(self, context):
        self.layout.prop(self, "python")


class NeuprimSettings(bpy.types.PropertyGroup):
    preset: EnumProperty(
        name="Quality",
        items=(
            ("preview", "Preview", "From voxels alone, below a minute for a short sequence"),
            ("quick", "Full", "From voxels and rendered images; minutes"),
        ),
    )
    lit: BoolProperty(name="Movable light", description="Train a model that the scene's sun can light")
    folder: StringProperty(name="Folder", description="Folder of the models", subtype="DIR_PATH", default="//neuprim")
    extra: StringProperty(name="Settings", description="More settings of neuprim run, such as scene.look=dust_tornado")


class _NeuprimOperator:
    """Base class of operators that start a job."""

    @classmethod
    def poll(cls, context):
        return _job is None

    def execute(self, context):
        try:
            return start(self, self.job(context))
        except (InputError, OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}


class NEUPRIM_OT_fit(_NeuprimOperator, bpy.types.Operator):
    """Fit a model to the selected OpenVDB sequence, and show it in place"""

    bl_idname, bl_label = "neuprim.fit", "Fit"

    resume: BoolProperty(name="Continue", description="Continue an interrupted fit")

    def job(self, context):
        return fit(context, self.resume)


class NEUPRIM_OT_render(_NeuprimOperator, bpy.types.Operator):
    """Render the model with the scene's camera as OpenEXR files with layers"""

    bl_idname, bl_label = "neuprim.render", "Render"

    animation: BoolProperty(name="Animation", description="All frames of the scene instead of the current one")

    def job(self, context):
        return render(context, self.animation)


class NEUPRIM_OT_cancel(bpy.types.Operator):
    """Stop neuprim. An interrupted fit can be continued"""

    bl_idname, bl_label = "neuprim.cancel", "Cancel"

    def execute(self, context):
        _cancel_job()
        return {"FINISHED"}


class NEUPRIM_PT_panel(bpy.types.Panel):
    bl_idname, bl_label, bl_category = "NEUPRIM_PT_panel", "neuprim", "neuprim"
    bl_space_type, bl_region_type = "VIEW_3D", "UI"

    def draw(self, context):
        layout, settings = self.layout, context.scene.neuprim
        layout.prop(settings, "preset")
        row = layout.row()
        row.enabled = settings.preset != "preview"
        row.prop(settings, "lit")
        layout.prop(settings, "folder")
        layout.prop(settings, "extra")
        row = layout.row(align=True)
        row.operator("neuprim.fit", text="Fit").resume = False
        row.operator("neuprim.fit", text="Continue").resume = True
        row = layout.row(align=True)
        row.operator("neuprim.render", text="Render Frame").animation = False
        row.operator("neuprim.render", text="Render Animation").animation = True
        if _job is not None:
            layout.progress(factor=_job.progress, text=_job.title)
            layout.label(text=_job.text)
            layout.operator("neuprim.cancel")
        elif _message:
            layout.label(text=_message, icon="ERROR" if _failed else "CHECKMARK")


CLASSES = (NeuprimPreferences, NeuprimSettings, NEUPRIM_OT_fit, NEUPRIM_OT_render, NEUPRIM_OT_cancel, NEUPRIM_PT_panel)


def register():
    for made in CLASSES:
        bpy.utils.register_class(made)
    bpy.types.Scene.neuprim = PointerProperty(type=NeuprimSettings)


def unregister():
    _cancel_job()
    del bpy.types.Scene.neuprim
    for made in reversed(CLASSES):
        bpy.utils.unregister_class(made)
