"""A trainer of your own in thirty lines: torch's Adam on random primitives, fitted to six views of a ball with stripes.

python examples/train_your_own.py [STEPS]
"""

import sys

import torch

import neuprim
from neuprim.core.cameras import look_at

SIZE, COUNT, NEURONS, VIEWS = 32, 60, 4, 6


def truth(viewmats: torch.Tensor, Ks: torch.Tensor) -> torch.Tensor:
    """Images (C, H, W, 3) of a ball of radius 0.7 round the origin, coloured by its own wavy density, on white."""
    ball = {
        "means": torch.zeros(1, 3),
        "log_scales": torch.full((1, 3), 0.7).log(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "W1": torch.tensor([[[0.3, 0.1, 0.0]]]),
        "b1": torch.zeros(1, 1),
        "w2": torch.tensor([[2.0]]),
        "b2": torch.tensor([[1.5]]),
        "colors": torch.tensor([[0.9, 0.3, 0.1]]),
    }
    return neuprim.rasterize(ball, viewmats, Ks, (SIZE, SIZE), backgrounds=torch.ones(3)).rgb


def train(steps: int = 200) -> list[float]:
    """The loss before every step."""
    torch.manual_seed(0)
    eyes = torch.nn.functional.normalize(torch.randn(VIEWS, 3), dim=1) * 3
    viewmats = torch.stack([look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes])
    Ks = torch.tensor([[1.5 * SIZE, 0.0, SIZE / 2], [0.0, 1.5 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]]).expand(VIEWS, 3, 3)
    images = truth(viewmats, Ks)

    primitives = {
        "means": torch.rand(COUNT, 3) - 0.5,
        "log_scales": torch.full((COUNT, 3), 0.2).log(),
        "quats": torch.randn(COUNT, 4),
        "W1": (torch.rand(COUNT, NEURONS, 3) - 0.5) / 3,
        "b1": torch.rand(COUNT, NEURONS),
        "w2": 0.1 * torch.randn(COUNT, NEURONS),
        "b2": torch.full((COUNT, 1), 0.3),
        "colors": torch.rand(COUNT, 3),
    }
    rates = {
        "means": 3e-3,
        "log_scales": 1e-2,
        "quats": 1e-2,
        "W1": 1e-3,
        "b1": 1e-3,
        "w2": 1e-2,
        "b2": 1e-2,
        "colors": 2e-2,
    }
    optimizer = torch.optim.Adam(
        [{"params": [p.requires_grad_()], "lr": rates[name]} for name, p in primitives.items()]
    )
    losses = []
    for step in range(steps):
        frames = neuprim.rasterize(primitives, viewmats, Ks, (SIZE, SIZE), backgrounds=torch.ones(3))
        loss = (frames.rgb - images).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if step % 20 == 0 or step == steps - 1:
            print(f"step {step:4d}  loss {losses[-1]:.4f}")
    return losses


if __name__ == "__main__":
    train(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
