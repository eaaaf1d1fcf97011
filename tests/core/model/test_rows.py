"""Some rows of many tensors, forward and backward, against torch's own."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.model.rows import take_primitive_rows

pytestmark = pytest.mark.usefixtures("either_way")

ROWS = {"some": [1, 2, 5, 8], "all": list(range(9)), "none": [], "the first": [0], "the last": [8]}


def tensors(dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "W1": (2, 3), "b2": (1,), "scalar": (), "nothing": (0, 3)}
    return {
        n: torch.randn(9, *s, generator=g, dtype=torch.float64).to(dtype).requires_grad_() for n, s in shapes.items()
    }


def pull(taken: dict[str, Tensor]) -> None:
    g = torch.Generator().manual_seed(1)
    weights = {n: torch.randn(x.shape, generator=g, dtype=torch.float64).to(x) for n, x in taken.items()}
    sum(((weights[n] * x).sum() for n, x in taken.items()), torch.zeros(())).backward()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", ROWS)
def test_it_is_index_select(case: str, dtype: torch.dtype) -> None:
    rows, mine, theirs = torch.tensor(ROWS[case], dtype=torch.int64), tensors(dtype), tensors(dtype)
    taken, wanted = take_primitive_rows(mine, rows), {n: x.index_select(0, rows) for n, x in theirs.items()}
    assert list(taken) == list(mine)
    assert all(torch.equal(taken[n], wanted[n]) and taken[n].dtype == dtype for n in wanted)
    pull(taken)
    pull(wanted)
    for name in mine:
        found, expected = mine[name].grad, theirs[name].grad
        assert found is not None and expected is not None and torch.equal(found, expected), name


def test_strides_do_not_matter_and_what_nothing_is_asked_of_has_no_gradient() -> None:
    wide = torch.randn(3, 9, generator=torch.Generator().manual_seed(2))
    turned, unused = wide.t().requires_grad_(), torch.ones(9, 2, requires_grad=True)
    rows = torch.tensor([0, 4])
    taken = take_primitive_rows({"turned": turned, "unused": unused}, rows)
    assert torch.equal(taken["turned"], wide.t()[rows])
    taken["turned"].sum().backward()  # an expanded gradient, of stride 0
    assert turned.grad is not None and turned.grad.sum(1).tolist() == [3, 0, 0, 0, 3, 0, 0, 0, 0]
    assert unused.grad is None


@pytest.mark.parametrize("count", [3, 5000])
def test_without_a_gradient_few_and_many_rows(count: int) -> None:
    g = torch.Generator().manual_seed(3)
    mine = {
        "means": torch.randn(6000, 3, generator=g),
        "nothing": torch.zeros(6000, 0, 3),
        "b2": torch.randn(6000, generator=g).requires_grad_(),
    }
    rows = torch.randperm(6000, generator=g)[:count].sort().values
    with torch.no_grad():
        taken = take_primitive_rows(mine, rows)
    assert all(torch.equal(taken[n], x[rows]) and not taken[n].requires_grad for n, x in mine.items())
