"""The fused colour network and the fused reading of depth images, against torch in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.compute.threads import limited
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.relight import colour_cpu
from neuprim.tasks.relight.colour import FORMS, LightNetwork
from neuprim.tasks.relight.visibility_cpu import arriving_light

COUNT = 600  # more than one unit of work


def camera(x: float = 1.0, y: float = 2.0, z: float = -4.0, dtype: torch.dtype = torch.float64) -> Camera:
    at = torch.tensor([x, y, z], dtype=dtype)
    return Camera(look_at(at, torch.zeros(3, dtype=dtype), torch.tensor([0.0, 0.0, 1.0], dtype=dtype)), 50.0, 50.0, 8.0, 8.0, 16, 16)


def given(field: LightNetwork, seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), **{spec.name: spec.shape for spec in field.parameters()}}
    made = {name: torch.randn(COUNT, *shape, generator=generator) for name, shape in shapes.items()}
    made["c_dc"][0] = 0.0  # where max(0, .) begins
    return made


def lowered(field: LightNetwork, params: dict[str, Tensor], view: Camera, light: dict[str, Tensor]) -> list[Tensor]:
    own = {name: value for name, value in params.items() if name != "means"}
    geometry = Geometry(params["means"], torch.zeros(COUNT, 3), torch.ones(COUNT, 4))
    form = field.lower(own, geometry, view, light)
    return [form.Wx, form.bias, form.Wout, form.base]


LIGHTS = {
    "near": (0.3, -0.2, 0.5),
    "at a centre": None,
    "far": (3e3, -2e3, 4e3),
    "at infinity": (0.0, 2e18, -3e18),
}


@pytest.mark.parametrize("where", LIGHTS)
@pytest.mark.parametrize("falloff", [False, True])
@pytest.mark.parametrize("hidden", [0, 5])
@pytest.mark.parametrize("form", FORMS)
def test_the_network_forward_and_backward(form: str, hidden: int, falloff: bool, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    monkeypatch.setattr(colour_cpu._Network, "apply", lambda *a, run=colour_cpu._Network.apply: used.append(1) or run(*a))  # type: ignore[func-returns-value]
    field = LightNetwork(hidden, 3, form, "none", boost=3.0, falloff=falloff, typical=1.7)
    start = given(field, 3)
    place = LIGHTS[where]
    light = start["means"][7].clone() if place is None else torch.tensor(place)
    conditions = {"light": light, "light_intensity": torch.tensor([2.0, 0.5, 0.0])}
    view = camera()
    view = camera(*start["means"][9].double().tolist()) if where == "near" else view  # a camera in a centre, too
    mine = {name: value.clone().requires_grad_() for name, value in start.items()}
    exact = {name: value.double().requires_grad_() for name, value in start.items()}
    found, wanted = lowered(field, mine, view, conditions), lowered(field, exact, view, conditions)
    assert used == [1], "float32 is fused, float64 is not"
    generator = torch.Generator().manual_seed(5)
    pull = [torch.randn(x.shape, generator=generator) for x in found]
    torch.autograd.backward(found, pull)
    torch.autograd.backward(wanted, [p.double() for p in pull])
    for a, b in zip(found, wanted, strict=True):
        assert a.dtype == torch.float32 and a.shape == b.shape
        assert torch.allclose(a.double(), b, rtol=2e-6, atol=2e-9 * float(b.detach().abs().sum()) / max(b.numel(), 1) + 1e-38)
    for name, value in mine.items():
        a, b = value.grad, exact[name].grad
        assert a is not None and b is not None, name
        if b.numel():
            size = b.reshape(COUNT, -1).abs().amax(1)
            assert bool(((a - b).reshape(COUNT, -1).abs().amax(1) <= 1e-5 * size + 1e-7 * size.median() + 1e-38).all()), name


def test_a_camera_or_a_light_that_wants_a_gradient_gets_it() -> None:
    field = LightNetwork(3)
    params = given(field, 1)
    for name in ("light", "light_intensity"):
        conditions = {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.ones(3)}
        conditions[name].requires_grad_()
        sum((x.square().sum() for x in lowered(field, params, camera(), conditions)), torch.zeros(())).backward()
        found = conditions[name].grad
        assert found is not None and bool((found != 0).all()), name
    view = camera()
    view.viewmat.requires_grad_()
    conditions = {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.ones(3)}
    sum((x.square().sum() for x in lowered(field, params, view, conditions)), torch.zeros(())).backward()
    assert view.viewmat.grad is not None and view.viewmat.grad.abs().sum() > 0


def test_the_network_does_not_depend_on_the_number_of_threads() -> None:
    field = LightNetwork(4, falloff=True)
    conditions = {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.ones(3)}
    results = []
    for threads in (1, 3):
        params = {name: value.requires_grad_() for name, value in given(field, 2).items()}
        with limited(threads):
            made = lowered(field, params, camera(), conditions)
            torch.autograd.backward(made, [x.detach() for x in made])
        results.append([*made, *(x.grad for x in params.values())])
    assert all(a is not None and b is not None and torch.equal(a, b) for a, b in zip(*results, strict=True))


# ---------------------------------------------------------------- depth images


def read(points: Tensor, view: Tensor, near: float, focal: float, alphas: Tensor, depths: Tensor, bias: float, softness: float) -> Tensor:
    """As torch samples images: outside of them nothing is in the way."""
    half = 0.5 * alphas.shape[1]
    nearness = torch.where(alphas > 0, alphas.double() / depths.double().clamp_min(near), 0.0)
    image = torch.stack([alphas.double(), nearness], 1)
    x, y, z = (points @ view[:, :3].T + view[:, 3]).unbind(-1)
    where = torch.stack([x, y], -1) * (focal / half / z.clamp_min(near))[:, None]
    found = F.grid_sample(image.flatten(0, 1)[None], where.clamp(-2, 2)[None, None], align_corners=False)[0, :, 0].unflatten(0, (-1, 2))
    behind = z - found[:, 0] / found[:, 1].clamp_min(1e-12)
    u = (0.5 + 0.5 * (behind - bias) / softness).clamp(0, 1)
    return torch.where(z > near, (1 - found[:, 0] * u * u * (3 - 2 * u)).prod(0), 1.0)


@pytest.mark.parametrize("slabs", [1, 4])
def test_depth_images_are_read_as_torch_reads_them(slabs: int) -> None:
    """Points anywhere: inside the images, across their borders, beside and behind the camera and at its centre."""
    generator = torch.Generator().manual_seed(slabs)
    size, near, focal = 24, 0.05, 20.0
    alphas = torch.rand(slabs, size, size, generator=generator)
    alphas[torch.rand(alphas.shape, generator=generator) < 0.4] = 0.0
    depths = torch.where(alphas > 0, 0.01 + 4 * torch.rand(alphas.shape, generator=generator), 0.0)
    view = camera().viewmat[:3].contiguous()
    points = 6 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 3
    points[:50] = camera().position + 1e-3 * points[:50]
    points[50] = camera().position
    edge = torch.rand(200, 3, generator=generator, dtype=torch.float64)  # about the border of the images
    side = torch.where(edge[:, 0] < 0.5, -1.0, 1.0) * (size / 2 + (edge[:, 1] - 0.5) * 3) / focal
    local = torch.stack([side, 0.4 * (edge[:, 2] - 0.5), torch.ones(200, dtype=torch.float64)], -1) * 3
    points = torch.cat([points, (local - view[:, 3]) @ view[:, :3]])
    found = np.full(len(points), -1.0, np.float32)
    arriving_light(0, len(points), points.numpy(), view.numpy(), near, focal, alphas.numpy(), depths.numpy(), 0.2, 0.3, found)
    wanted = read(points, view, near, focal, alphas, depths, 0.2, 0.3).float()
    assert torch.allclose(torch.from_numpy(found), wanted, rtol=0, atol=1e-6)
    assert 0.1 < float((wanted < 0.99).float().mean()) and float(wanted.min()) < 0.3
    assert found[50] == 1.0


def test_points_that_are_not_finite_are_lit() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, -np.inf]])
    found = np.zeros(3, np.float32)
    ones = np.ones((1, 8, 8), np.float32)
    arriving_light(0, 3, points, camera().viewmat[:3].contiguous().numpy(), 0.05, 20.0, ones, ones, 0.1, 0.1, found)
    assert found.tolist() == [1.0, 1.0, 1.0]


def test_primitives_of_one_model_share_a_network() -> None:
    """Through ``Primitives.lower``, where the density's own rows are left out: nothing is mixed up."""
    field = LightNetwork(2, visibility="none")
    params = given(field, 8)
    from neuprim.core.model.densities.cosine import CosineDensity

    shapes = {spec.name: spec.shape for spec in CosineDensity(1).parameters()}
    rest = {"log_scales": torch.zeros(COUNT, 3), "quats": torch.ones(COUNT, 4), **{n: torch.ones(COUNT, *s) for n, s in shapes.items()}}
    model = Primitives(CosineDensity(1), field, {**params, **rest})
    conditions = {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.ones(3)}
    colour = model.lower(camera(), conditions).colour
    assert torch.equal(colour.tensors()["bias"], lowered(field, params, camera(), conditions)[1])
