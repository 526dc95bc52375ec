"""Anderson's mixing: where rounds that shrink, or swing to and fro, would end.

A round leads a vertex from where it is to where it should be on the surface as seen from there, and to
another normal and curvature of that surface. Near the end such a map is linear, and of the last rounds'
answers those shares are mixed whose changes cancel best (D. G. Anderson 1965; Walker and Ni 2011,
SIAM J. Numer. Anal. 49(4), Eq. 2.2): with three of them a few rounds do what ten would.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

ROUNDS = 3  # mixed, at most: there are three slow directions, two of the place and the bend
LEAP = 10.0  # times the last change: no mix leads further
RIDGE = 1e-12  # of a change: among changes that are all alike, the least shares


@dataclass
class History:
    """What the last rounds of each chain led to and what they changed, latest first."""

    led: Float[Tensor, "c h n"]
    change: Float[Tensor, "c h n"]

    @staticmethod
    def none(chains: int, size: int, like: Tensor) -> "History":
        return History(*(like.new_zeros(chains, ROUNDS, size) for _ in range(2)))

    def mixed(
        self,
        rows: Int[Tensor, "m"],
        led: Float[Tensor, "m n"],
        change: Float[Tensor, "m n"],
        scale: Float[Tensor, "m n"],
        rounds: int,
    ) -> Float[Tensor, "m n"]:
        """The mix of the answers ``led`` with those of up to ``rounds`` before; these are kept.

        scale: what makes changes comparable; what weighs 0 has no say and is mixed all the same.
        """
        rounds = min(rounds, ROUNDS)
        answer = led
        if rounds:
            answer = _mixed(led, change, self.led[rows, :rounds], self.change[rows, :rounds], scale)
        for kept, now in ((self.led, led), (self.change, change)):
            kept[rows] = torch.cat([now[:, None], kept[rows, :-1]], 1)
        return answer


def _mixed(
    led: Tensor, change: Tensor, led_before: Tensor, before: Tensor, scale: Tensor
) -> Float[Tensor, "m n"]:
    size = (change * scale)[..., None]
    turn = (change[:, None] - before) * scale[:, None]
    length = turn.norm(dim=2, keepdim=True)
    length = torch.where(length > 0, length, torch.ones_like(length))
    turn = turn / length
    matrix = turn @ turn.transpose(1, 2)
    matrix = matrix + RIDGE * torch.eye(matrix.shape[1], dtype=matrix.dtype, device=matrix.device)
    share = torch.linalg.solve(matrix, turn @ size) / length
    move = (share * (led[:, None] - led_before)).sum(1)
    far, most = (move * scale).norm(dim=1), LEAP * size[..., 0].norm(dim=1)
    return led - move * torch.where(far > most, most / torch.where(far > 0, far, 1.0), 1.0)[:, None]
