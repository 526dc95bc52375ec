"""The antennas at one end of a channel: radios that radiate alike are asked together."""

from collections.abc import Callable

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.scene.antennas import basis
from rfsg.scene.radios import Radio, amplitude, field_components


class Antennas:
    """Radios, and for each the number of its kind: one pattern, polarisation and orientation.

    A thousand receivers are a thousand radios and, mostly, one kind.
    """

    def __init__(self, radios: tuple[Radio, ...], device: torch.device):
        number: dict[object, int] = {}
        self.kinds: list[Radio] = []
        owner = []
        for radio in radios:
            key = _key(radio)
            if key not in number:
                number[key] = len(self.kinds)
                self.kinds.append(radio)
            owner.append(number[key])
        self.kind = torch.tensor(owner, dtype=torch.int64, device=device)
        self.plain = all(r.pattern == "isotropic" for r in self.kinds)

    def components(
        self, index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
    ) -> Complex[Tensor, "p 2"]:
        """(theta, phi) field of each path's radio, its first port, along a world direction."""
        return self._asked(index, direction, _first_port)

    def patterns(
        self, index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
    ) -> Float[Tensor, "p"]:
        """Amplitude pattern sqrt(G) of each path's radio along a world direction."""
        if self.plain:
            return torch.ones(len(index), dtype=torch.float64, device=direction.device)
        return self._asked(
            index, direction, lambda r, d: amplitude(r, d @ r.rotation.to(d)).to(d.dtype)
        )

    def basis(
        self, index: Int[Tensor, "p"], direction: Float[Tensor, "p 3"]
    ) -> Float[Tensor, "p 2 3"]:
        """Rows theta-hat and phi-hat, in the world, of each path's radio along a direction."""
        return self._asked(index, direction, _basis)

    def _asked(
        self, index: Tensor, direction: Tensor, ask: Callable[[Radio, Tensor], Tensor]
    ) -> Tensor:
        """One answer for every path, asked of each kind of radio once."""
        if len(self.kinds) == 1 or not len(index):
            return ask(self.kinds[0] if self.kinds else _NOBODY, direction)
        kind = self.kind[index]
        order = torch.argsort(kind, stable=True)
        present, count = torch.unique_consecutive(kind[order], return_counts=True)
        parts = zip(present.tolist(), direction[order].split(count.tolist()), strict=True)
        return torch.cat([ask(self.kinds[k], d) for k, d in parts])[torch.argsort(order)]


_NOBODY = Radio.at("/nobody", 0.0, 0.0, 0.0)


def _key(radio: Radio) -> object:
    """What tells the antennas of two radios apart; one whose turn is sought is like no other."""
    pattern = radio.pattern if isinstance(radio.pattern, str) else id(radio.pattern)
    turn = radio.rotation
    turned = id(turn) if turn.requires_grad else tuple(turn.flatten().tolist())
    return pattern, radio.polarization, turned


def _first_port(radio: Radio, direction: Tensor) -> Tensor:
    return field_components(radio, direction @ radio.rotation.to(direction))[:, 0]


def _basis(radio: Radio, direction: Tensor) -> Tensor:
    rotation = radio.rotation.to(direction)
    return basis(direction @ rotation) @ rotation.mT
