"""What the tests run in Blender's Python: ``python in_blender.py CHECK ADDON.zip FOLDER``.

FOLDER has the sequence ball_1001.vdb to ball_1004.vdb. A check prints nothing and fails with a traceback.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
from mathutils import Matrix, Vector

CHECK, ADDON, FOLDER = sys.argv[-3], sys.argv[-2], Path(sys.argv[-1])
SMALL = "scene.size=32 scene.cameras=6 model.primitives=300 train.iterations=80"


def select_sequence(name: str = "ball_1001.vdb") -> Any:
    """A volume object of the sequence, turned, scaled and moved."""
    files = [{"name": path.name} for path in sorted(FOLDER.glob("ball_*.vdb"))]
    bpy.ops.object.volume_import(filepath=str(FOLDER / name), directory=str(FOLDER), files=files)
    source = bpy.context.object
    source.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Rotation(0.7, 4, (1, 2, 3)) @ Matrix.Scale(2, 4)
    bpy.context.view_layer.update()
    return source


def model_of(source: Any) -> Any:
    (found,) = source.children
    bpy.context.view_layer.update()
    return found


def look_at_model(shown: Any) -> None:
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    assert shown.data.grids.load(), shown.data.grids.error_message
    corners = [shown.matrix_world @ Vector(corner) for corner in shown.bound_box]
    center = sum(corners, Vector()) / 8
    camera.location = center + 2.5 * (corners[6] - corners[0]).length * Vector((0.3, -1, 0.4)).normalized()
    camera.rotation_euler = (center - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.clip_end, camera.data.shift_x = 1e5, 0.1
    scene.render.resolution_x, scene.render.resolution_y = 160, 90


def refused(call: Any, *texts: str, **more: Any) -> None:
    """The operator fails with one line that has all texts."""
    try:
        call(**more)
    except RuntimeError as error:
        message = str(error).strip()
        assert "\n" not in message and all(text in message for text in texts), message
        return
    raise AssertionError(f"expected an error with {texts}")


def check_fit_and_render(addon: Any, settings: Any) -> None:
    """The model stands where the sequence does, plays with it, and Cycles sees it where neuprim draws it."""
    scene, source = bpy.context.scene, select_sequence()
    settings.preset, settings.extra = "preview", "train.iterations=250"
    assert bpy.ops.neuprim.fit() == {"FINISHED"}
    shown = model_of(source)
    assert source.hide_render and shown.matrix_world == source.matrix_world
    names = ("is_sequence", "frame_start", "frame_offset", "frame_duration")
    assert [getattr(shown.data, name) for name in names] == [getattr(source.data, name) for name in names]
    assert Path(shown.data.filepath).name.endswith("1001.vdb")

    scene.frame_start, scene.frame_end = source.data.frame_start - 1, source.data.frame_start + 5
    scene.frame_set(source.data.frame_start + 1)
    look_at_model(shown)
    assert bpy.ops.neuprim.render() == {"FINISHED"}
    assert bpy.ops.neuprim.render(animation=True) == {"FINISHED"}
    assert scene.frame_current == source.data.frame_start + 1
    run = Path(shown[addon.RUN])
    expected = [f"ball_1001_model.{source.data.frame_start + k:04d}.exr" for k in range(4)]
    assert sorted(path.name for path in (run / "blender").iterdir()) == expected, "outside its frames it has no files"
    assert {image.source for image in bpy.data.images if image.name.endswith(".exr")} == {"FILE", "SEQUENCE"}

    import addon_utils

    addon_utils.enable("cycles")
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    scene.render.engine, scene.cycles.samples, scene.render.film_transparent = "CYCLES", 16, True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(FOLDER / "cycles.exr")
    bpy.ops.render.render(write_still=True)

    shown.data.sequence_mode = "REPEAT"  # more frames than files: several commands
    assert bpy.ops.neuprim.render(animation=True) == {"FINISHED"}
    assert len(list((run / "blender").iterdir())) == 7
    for path in (run / "blender").iterdir():
        path.unlink()
    job = addon.render(bpy.context, animation=True)
    job.wait()
    job.error = "cancelled"
    try:
        job.finish()
    except addon.InputError as error:
        assert str(error) == "cancelled"
    assert len(list((run / "blender").iterdir())) == 7, "what was rendered before is kept"


def check_sun(addon: Any, settings: Any) -> None:
    """The sun of the scene lights the model, from its own direction."""
    source = select_sequence()
    settings.preset, settings.lit, settings.extra = "quick", True, SMALL
    assert bpy.ops.neuprim.fit() == {"FINISHED"}
    shown = model_of(source)
    look_at_model(shown)
    refused(bpy.ops.neuprim.render, "0 suns light the scene", "exactly one")
    for k, energy in enumerate((5.0, 0.0)):
        sun = bpy.data.objects["Light"]
        sun.data.type = "SUN"
        bpy.data.lights[sun.data.name].energy = energy
        sun.rotation_euler = (0.4, 0.3, 0.0)
        bpy.context.view_layer.update()
        bpy.context.scene.frame_set(source.data.frame_start + 1)
        assert bpy.ops.neuprim.render() == {"FINISHED"}
        (written,) = (Path(shown[addon.RUN]) / "blender").iterdir()
        written.rename(FOLDER / f"sun_{k}.exr")
    flag, where, *_ = addon.light_flags(bpy.context.scene, shown, addon.rigid_inverse(shown))
    towards = shown.matrix_world @ Vector(map(float, where.split(","))) - shown.matrix_world.translation
    assert flag == "--light" and math.degrees(towards.angle(sun.matrix_world.to_3x3().col[2])) < 0.5


def check_usd_cameras(addon: Any, settings: Any) -> None:
    """Write the scene's moving camera as USD, as users do, and the poses and projections that Blender computes."""
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    scene.render.resolution_x, scene.render.resolution_y = 320, 180
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = 37, 0.1, -0.07
    scene.frame_start, scene.frame_end, found = 5, 8, []
    for frame in (5, 8):
        camera.location.x, camera.rotation_euler.z = frame, 0.1 * frame
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    bpy.ops.wm.usd_export(filepath=str(FOLDER / "shot.usda"), export_animation=True)
    for frame in range(5, 9):
        scene.frame_set(frame)
        projection = camera.calc_matrix_camera(bpy.context.evaluated_depsgraph_get(), x=320, y=180)
        matrices = (camera.matrix_world.normalized(), projection)
        found.append([[list(row) for row in matrix] for matrix in matrices])
    (FOLDER / "shot.json").write_text(json.dumps(found))


def check_wrong_input(addon: Any, settings: Any) -> None:
    fit, draw = bpy.ops.neuprim.fit, bpy.ops.neuprim.render
    refused(fit, "no OpenVDB sequence is selected")
    refused(draw, "no model of neuprim")
    source = select_sequence()
    settings.folder = "//neuprim"
    refused(fit, "save the .blend file first")
    settings.folder = str(FOLDER / "models")
    settings.extra = "model.primitive=300"
    refused(fit, "model.primitive", "primitives")
    settings.extra = "'"
    refused(fit, "No closing quotation")
    settings.extra = ""
    source.scale = (1, 2, 1)
    bpy.context.view_layer.update()
    refused(fit, "expected a uniform scale")
    source.scale = (1, 1, 1)
    source.data.frame_offset += 7
    refused(fit, "1008")
    preferences = bpy.context.preferences.addons[addon.__package__].preferences
    kept, preferences.python = preferences.python, str(FOLDER / "no-python")
    refused(fit, "no-python: not found")
    preferences.python = kept
    source[addon.RUN] = str(FOLDER / "gone")
    refused(draw, "no such run directory")
    assert not list(FOLDER.glob("models/*/model.safetensors"))


def check_interrupted_fit(addon: Any, settings: Any) -> None:
    """A fit that the panel follows can be cancelled and continued; the panel shows what happens."""
    source, drawn = select_sequence(), []
    settings.preset, settings.extra = "preview", "train.iterations=4000"
    layout = SimpleNamespace(
        prop=lambda *a, **k: None,
        row=lambda **k: layout,
        operator=lambda name, **k: SimpleNamespace(),
        progress=lambda **k: drawn.append(k["text"]),
        label=lambda **k: drawn.append(k["text"]),
    )
    panel = SimpleNamespace(layout=layout)
    draw = bpy.types.NEUPRIM_PT_panel.draw
    addon._job = addon.fit(bpy.context, resume=False)
    run = FOLDER / "models" / "ball_1001"
    while not (run / "renders" / "preview.png").exists():
        assert addon._follow() == 0.3
        draw(panel, bpy.context)
        time.sleep(0.1)
    assert not bpy.ops.neuprim.fit.poll(), "one job at a time"
    assert "fit ball_1001" in drawn and any("ground truth" in text for text in drawn)
    assert bpy.ops.neuprim.cancel() == {"FINISHED"}
    while addon._follow() is not None:
        time.sleep(0.1)
    draw(panel, bpy.context)
    assert drawn[-1] == "fit ball_1001: cancelled" and not source.children
    assert (run / "checkpoint.safetensors").exists()
    settings.extra = "train.iterations=100"
    assert bpy.ops.neuprim.fit(resume=True) == {"FINISHED"}
    assert model_of(source)[addon.RUN] == str(run)
    refused(bpy.ops.neuprim.fit, "no interrupted fit of ball_1001", resume=True)
    assert bpy.ops.neuprim.fit() == {"FINISHED"}
    assert sorted(path.name for path in run.parent.iterdir()) == ["ball_1001", "ball_1001_2"]

    addon._job = addon.fit(bpy.context, resume=False)
    source.name = "renamed"
    while addon._follow() is not None:
        time.sleep(0.1)
    assert addon._message.startswith("ball_1001 is gone; its model is in ") and addon._failed
    assert json.loads((run / "metrics.json").read_text())["psnr"] > 0


def main() -> None:
    bpy.ops.extensions.package_install_files(filepath=ADDON, repo="user_default", enable_on_install=True)
    from bl_ext.user_default import neuprim as addon

    bpy.ops.object.select_all(action="DESELECT")
    bpy.context.view_layer.objects.active = None
    settings = bpy.context.scene.neuprim
    settings.folder = str(FOLDER / "models")
    globals()[f"check_{CHECK}"](addon, settings)
    bpy.ops.preferences.addon_disable(module=addon.__package__)


main()
