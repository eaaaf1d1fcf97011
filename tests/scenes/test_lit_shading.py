"""Light on solids with known answers: Lambert under a point light, shadows where geometry says, highlights where the
half vector is."""

from __future__ import annotations

import numpy as np

from neuprim.scenes import PIXEL_CLASSES
from neuprim.scenes.image_set import camera_pose
from neuprim.scenes.lit import (
    FIELD_OF_VIEW,
    PARTS,
    ShadedRays,
    draw_lit_solids,
    place_cameras_and_lights,
    shade_point_light,
)
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shapes import Solid, ball, chamfered_box, parse_srgb, uniform_colour

GREY = "#808080"
FLOOR = Solid("floor", chamfered_box([4, 4, 0.1], [0, 0, -0.05], 0.001), uniform_colour(GREY), 0.0)
BLOCK = Solid("block", chamfered_box([0.4, 0.4, 0.2], [0, 0, 0.6], 0.0005), uniform_colour("#ffffff"), 0.0)


def down(
    scene: Scene, points: list[tuple[float, float]], light: tuple[float, float, float], height: float = 0.3
) -> ShadedRays:
    """What rays straight down from ``height`` see at (x, y) points."""
    origins = np.array([[x, y, height] for x, y in points])
    return shade_point_light(scene, origins, np.tile([[0.0, 0.0, -1.0]], (len(points), 1)), light, 2.0)


def names(shaded: ShadedRays) -> list[str]:
    return [PIXEL_CLASSES[c] for c in shaded.classes]


def test_lambert_under_a_point_light() -> None:
    light = (0.3, -0.2, 2.0)
    points = [(0.3, -0.2), (0.0, 0.0), (-1.0, 1.5)]
    seen = down(Scene([FLOOR]), points, light)
    for (x, y), rgb in zip(points, seen.rgb, strict=True):
        square = (x - 0.3) ** 2 + (y + 0.2) ** 2 + 4.0
        np.testing.assert_allclose(rgb, parse_srgb(GREY) / np.pi * (2.0 / np.sqrt(square)) * 2.0 / square, rtol=1e-4)
    assert names(seen) == ["lit"] * 3
    np.testing.assert_array_equal(seen.rgb, seen.unshadowed)


def test_the_shadow_of_a_box_lies_where_its_edges_project() -> None:
    """Under a light at (1, 0, 2) the upper edge of the far side projects to 1 - 1.2 * 2 / 1.3, the lower one of the
    near side to 1 - 0.8 * 2 / 1.5."""
    seen = down(Scene([FLOOR, BLOCK]), [(x, 0.0) for x in (-0.86, -0.83, -0.4, -0.08, -0.05, 0.2)], (1.0, 0.0, 2.0))
    assert names(seen) == ["lit", "cast_shadow", "cast_shadow", "cast_shadow", "lit", "lit"]
    cast = seen.classes == PIXEL_CLASSES.index("cast_shadow")
    assert not seen.rgb[cast].any() and (seen.unshadowed[cast] > 0.01).all()
    alone = down(Scene([FLOOR]), [(-0.4, 0.0)], (1.0, 0.0, 2.0))
    np.testing.assert_allclose(seen.unshadowed[2], alone.rgb[0], rtol=1e-5)


def test_what_faces_away_is_in_attached_shadow() -> None:
    sphere = Scene([Solid("ball", ball([0, 0, 0], 0.5), uniform_colour("#ffffff"), 0.0)])
    heights = np.array([0.45, 0.2, 0.1, 0.02, -0.1, -0.4])
    origins = np.stack([np.full(6, 3.0), np.zeros(6), heights], axis=1)
    seen = shade_point_light(sphere, origins, np.tile([[-1.0, 0, 0]], (6, 1)), (0.0, 0.0, 5.0), 1.0)
    # The terminator of a light at distance 5 from the middle lies at height 0.5 * 0.5 / 5 = 0.05.
    assert names(seen) == ["lit", "lit", "lit", "attached_shadow", "attached_shadow", "attached_shadow"]
    assert not seen.unshadowed[3:].any()


def test_the_highlight_lies_where_the_normal_is_the_half_vector() -> None:
    sphere = Scene([Solid("ball", ball([0, 0, 0], 1.0), uniform_colour("#101010"), 0.6, specular=1.5)])
    eye, light = np.array([4.2, 0.0, 1.0]), np.array([1.5, 3.0, 3.0])
    image = draw_lit_solids(sphere, camera_pose(eye), light, 128, 1)
    row, column = np.unravel_index(image.rgba[..., 1].argmax(), (128, 128))
    pose, plane = camera_pose(eye), np.tan(FIELD_OF_VIEW / 2)
    ray = pose[:3, :3] @ [((column + 0.5) / 64 - 1) * plane, (1 - (row + 0.5) / 64) * plane, -1.0]
    hits = sphere.intersect(eye[None], ray[None])
    to_eye, to_light = (v - hits.position[0] for v in (eye, light))
    half = to_eye / np.linalg.norm(to_eye) + to_light / np.linalg.norm(to_light)
    assert hits.normal[0] @ half / np.linalg.norm(half) > np.cos(np.radians(3.0))
    assert PIXEL_CLASSES[image.classes[row, column]] == "highlight"
    assert 0.001 < (image.classes == PIXEL_CLASSES.index("highlight")).mean() < 0.1


def test_a_pixel_has_the_class_of_most_of_its_rays() -> None:
    scene = Scene([FLOOR, BLOCK])
    coarse, fine = (
        draw_lit_solids(scene, camera_pose(np.array([2.0, -3.0, 2.5])), np.array([1.0, 1.0, 4.0]), n, s)
        for n, s in ((16, 4), (64, 1))
    )
    alpha = fine.rgba[..., 3].reshape(16, 4, 16, 4).sum((1, 3))
    np.testing.assert_array_equal(coarse.rgba[..., 3] * 16, alpha)
    blocks = fine.classes.reshape(16, 4, 16, 4).transpose(0, 2, 1, 3).reshape(16, 16, 16)
    for name in ("cast_shadow", "attached_shadow"):
        most = (blocks == PIXEL_CLASSES.index(name)).sum(-1) > alpha / 2
        np.testing.assert_array_equal(coarse.classes == PIXEL_CLASSES.index(name), most & (alpha >= 8))
    np.testing.assert_array_equal(coarse.classes == 0, alpha < 8)


# The rig
# -------------------------------------------------------------------------------------------------------------------------------


def test_parts_of_the_test_split_have_seen_what_they_say() -> None:
    found = place_cameras_and_lights(100, 20)
    cameras, lights = ({s.camera.tobytes() for s in found["train"]}, {s.light.tobytes() for s in found["train"]})
    counts = dict.fromkeys(PARTS, 0)
    for view in found["test"]:
        part = next(p for p in PARTS if view.name.startswith(p))
        counts[part] += 1
        assert (view.camera.tobytes() in cameras) == (part == "new_light"), view.name
        assert (view.light.tobytes() in lights) == (part == "new_view"), view.name
    assert list(counts.values()) == [7, 7, 6]
    assert len({s.name for s in found["test"]}) == 20 and found["test"][7].name == "new_light_00"
