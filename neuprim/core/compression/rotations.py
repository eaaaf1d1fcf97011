"""Orientations as codes: the three smallest components of a unit quaternion, whose signs and norms mean nothing.

With h = 2^(bits-1) - 1, the three are u / (h sqrt 2) for whole u from -h to h, in their order, and the largest is

    sqrt(2 h^2 - u1^2 - u2^2 - u3^2) / (h sqrt 2)

positive. Sum and difference are of whole numbers, a root and a quotient of double precision are rounded once: the same
bits everywhere.
Zero is among the values, so that primitives which never turned come back as they were.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["LEAST_BITS", "Rotations"]

LEAST_BITS = 3


@dataclass(frozen=True)
class Rotations:
    """How quaternions are coded: ``bits`` of each of three components, :data:`LEAST_BITS` to 16."""

    bits: int

    @property
    def half(self) -> int:
        """h: codes are u + h, 0 to 2 h."""
        return (1 << (self.bits - 1)) - 1

    def codes(self, quats: Tensor) -> Tensor:
        """(N, 4) int64 of wxyz (N, 4) of any norm but 0: which component is the largest, and the codes of the others.

        Where rounding would leave another component as large as the largest, it is made smaller: what was decoded is
        coded as it was.
        """
        q = quats.detach().double()
        q = q / q.abs().amax(1, keepdim=True)  # squares of the tiniest norms would vanish
        q = q / q.norm(dim=1, keepdim=True)
        largest = q.abs().argmax(1)
        q = torch.where(q.gather(1, largest[:, None]) < 0, -q, q)
        u = (q.gather(1, self._others(largest)) * (self.half * 2**0.5)).round().long().clamp(-self.half, self.half)
        while True:
            most, which = u.abs().max(1)
            over = (self._left(u) < (most + 1).square()) & (most > 0)
            if not bool(over.any()):
                return torch.cat([largest[:, None], u + self.half], 1)
            u = u.scatter_add(
                1, which[:, None], torch.where(over, -u.gather(1, which[:, None])[:, 0].sign(), 0)[:, None]
            )

    def values(self, codes: Tensor) -> Tensor:
        """(N, 4) float32 unit quaternions wxyz that codes (N, 4) stand for."""
        u = codes[:, 1:] - self.half
        norm = torch.tensor(2 * self.half * self.half, dtype=torch.float64, device=codes.device).sqrt()
        made = torch.empty(len(codes), 4, dtype=torch.float64, device=codes.device)
        made.scatter_(1, codes[:, :1], self._left(u).clamp_min(0).double().sqrt()[:, None] / norm)
        made.scatter_(1, self._others(codes[:, 0]), u.double() / norm)
        return made.float()

    def rounded(self, quats: Tensor) -> Tensor:
        """As it comes back but for its norm and sign, which stay, with the gradient of ``quats`` (straight through)."""
        q = quats.detach()
        back = self.values(self.codes(q)).to(q)
        back = back * q.norm(dim=1, keepdim=True) * torch.where((back * q).sum(1, keepdim=True) < 0, -1.0, 1.0).to(q)
        return back + (quats - q)

    def to(self, device: torch.device) -> Rotations:
        """The same for tensors elsewhere: itself."""
        return self

    def _left(self, u: Tensor) -> Tensor:
        return 2 * self.half * self.half - u.square().sum(1)

    @staticmethod
    def _others(largest: Tensor) -> Tensor:
        """(N, 3) the components that are not the largest, ascending."""
        first = torch.arange(3, device=largest.device).expand(len(largest), 3)
        return first + (first >= largest[:, None])
