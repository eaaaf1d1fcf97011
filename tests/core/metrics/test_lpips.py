"""LPIPS with weights made up here: against arithmetic by hand, and against the networks as their authors write them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from neuprim.core.errors import DataError
from neuprim.core.metrics.lpips import Lpips
from tests.lpips_weights import TAPS, features, weights, written


def images(size: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(size)
    truth = torch.rand(size, size + 5, 3, generator=generator)
    return (truth + 0.2 * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


@pytest.mark.parametrize("network", ["alex", "vgg"])
def test_it_is_the_distance_of_the_features_of_the_network(tmp_path: Path, network: str) -> None:
    state, net = weights(network), features(network)
    found = Lpips.load(written(tmp_path, state))
    assert found.network == network
    net.load_state_dict({key.removeprefix("features."): x for key, x in state.items() if key.startswith("features.")})
    rendered, truth = images(33)
    mean, deviation = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    for call, mapped in ((found, lambda x: 2 * x - 1), (found.unmapped, lambda x: x)):
        total, xs = 0.0, [((mapped(i) - mean) / deviation).permute(2, 0, 1)[None] for i in images(33)]
        with torch.no_grad():
            for index, layer in enumerate(net):
                xs = [layer(x) for x in xs]
                if index in TAPS[network]:
                    unit = [x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10) for x in xs]
                    weight = state[f"lin{TAPS[network].index(index)}.model.1.weight"]
                    total += nn.functional.conv2d((unit[0] - unit[1]) ** 2, weight).mean().item()
                if index == TAPS[network][-1]:
                    break
        assert call(rendered, truth) == pytest.approx(total, rel=1e-4) and total > 1e-4
    assert found(truth, truth) == 0.0 and found(rendered, truth) != found.unmapped(rendered, truth)


def test_every_published_form_of_the_weights_is_the_same(tmp_path: Path) -> None:
    state = weights("alex")
    plain = Lpips.load(written(tmp_path, state))(*images(40))
    whole = {key.replace("features.0.", "net.slice1.0."): value for key, value in state.items()}
    for k, index in enumerate((3, 6, 8, 10), 2):
        whole = {key.replace(f"features.{index}.", f"net.slice{k}.{index}."): value for key, value in whole.items()}
    whole |= {key.replace("lin", "lins."): value for key, value in state.items() if key.startswith("lin")}
    whole |= {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    assert Lpips.load(written(tmp_path, whole))(*images(40)) == plain
    save_file(state, tmp_path / "all.safetensors")
    assert Lpips.load(tmp_path / "all.safetensors")(*images(40)) == plain
    parts = tmp_path / "parts"
    parts.mkdir()
    backbone = {key: value for key, value in state.items() if key.startswith("features")}
    torch.save({**backbone, "classifier.1.weight": torch.zeros(2, 2)}, parts / "alexnet-owt-7be5be79.pth")
    torch.save({key: value for key, value in state.items() if key.startswith("lin")}, parts / "alex.pth")
    (parts / "README.md").write_text("not weights")
    assert Lpips.load(parts)(*images(40)) == plain


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: {k: v for k, v in s.items() if k != "lin3.model.1.weight"}, "lin3.model.1.weight of LPIPS (alex): "),
        (
            lambda s: {k: v for k, v in s.items() if k.startswith("lin")},
            "convolutions none; expected the layers of AlexNet",
        ),
        (lambda s: s | {"features.3.bias": torch.zeros(3)}, "features.3.bias of LPIPS (alex): shape (3,)"),
        (lambda s: s | {"features.3.bias": torch.full((192,), torch.nan)}, "expected finite numbers of shape (192,)"),
        (lambda s: s | {"features.12.weight": torch.zeros(1)}, "convolutions [0, 3, 6, 8, 10, 12]"),
        (lambda s: list(s), "found list; expected a state dictionary"),
        (lambda s: {"model": nn.Linear(2, 2)}, "cannot be read as weights"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, change, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DataError) as caught:
        Lpips.load(written(tmp_path, change(weights("alex"))))
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "weights.pth")) and text in message and "\n" not in message


class _Hostile:
    """Touches a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.file,)


def test_no_code_in_a_file_is_run(tmp_path: Path) -> None:
    touched = tmp_path / "touched"
    path = written(tmp_path, {**weights("alex"), "more": _Hostile(touched)})
    torch.load(path, weights_only=False)
    assert touched.exists()
    touched.unlink()
    with pytest.raises(DataError, match="cannot be read as weights"):
        Lpips.load(path)
    assert not touched.exists()
