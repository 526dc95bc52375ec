"""Derivatives of every surface on a few shapes: by every parameter, every point and direction."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing
from tests.laws.catalogue import F64, SURFACES, chords, contacts, made, names, some

FREQUENCY = torch.tensor([2.4e9, 28e9], dtype=F64)
STEP = 1e-6


class _Asked(nn.Module):
    """All that a body answers, as real numbers of order 1, by what it has and what it meets.

    turn: the normals of a stretch turn together, for whether they are parallel is no matter of
    degree; those of ends inside stay zero.
    """

    def __init__(self, body: Body, crossing: Crossing):
        super().__init__()
        self.body, self.normals = body, (crossing.normal_start, crossing.normal_end)

    def forward(self, point, incoming, outgoing, normal, start, end, turn) -> tuple[Tensor, ...]:
        contact = Contact(point, incoming, outgoing, normal)
        normals = (n + torch.linalg.cross(turn, n) for n in self.normals)
        crossing = Crossing(start, end, *normals)
        fields = [
            self.body.reflection(contact, FREQUENCY),
            self.body.transmission(crossing, FREQUENCY),
        ]
        if self.body.scattering is not None:
            fields.append(self.body.diffuse(contact, FREQUENCY))
        delay = 1e9 * self.body.excess_delay(crossing, FREQUENCY)
        return *map(torch.view_as_real, fields), delay


@pytest.mark.parametrize("surface", names(SURFACES))
@pytest.mark.parametrize("shape", ["box", "sphere", "cylinder", "neural"])
def test_every_answer_has_its_derivatives(shape, surface):
    """Autograd against central differences in float64, along a random direction in each input.

    Neither head on nor grazing, a hair off the face (a vertex inside counts as on it, so that there
    is a kink on it); the stretches are ``_rows``.
    """
    form, crossing = chords(shape)
    _, contact = contacts(shape)
    contact = some(contact, torch.tensor([2, 4, 5, 8]))
    contact = replace(contact, point=contact.point + 1e-4 * contact.normal)
    body = copy.deepcopy(Body(form, made(SURFACES, surface))).double()
    crossing = some(crossing, _rows(crossing, body.surface.kind != "stochastic"))
    asked = _Asked(body, crossing)
    met = {
        **{f"contact.{n}": x for n, x in vars(contact).items()},
        "start": crossing.start,
        "end": crossing.end,
        "turn": torch.zeros_like(crossing.end),
    }
    given = {**met, **dict(asked.named_parameters())}
    assert all(x.dtype == F64 for x in given.values())
    generator = torch.Generator().manual_seed(5)
    weights: list[Tensor] = []

    def answer(values: dict[str, Tensor]) -> Tensor:
        """A random mixture of all answers."""
        own = {n: x for n, x in values.items() if n not in met}
        found = torch.func.functional_call(asked, own, tuple(values[n] for n in met))
        if not weights:
            weights.extend(torch.randn(x.shape, generator=generator, dtype=F64) for x in found)
        mixed = [(w * x).sum() for w, x in zip(weights, found, strict=True)]
        constant = [0.0 * x.sum() for x in values.values()]  # a conductor's answers never change
        return torch.stack([*mixed, *constant]).sum()

    leaves = {n: x.detach().clone().requires_grad_() for n, x in given.items()}
    slopes = torch.autograd.grad(answer(leaves), list(leaves.values()))
    size = max(float(s.norm()) for s in slopes)
    for (name, x), slope in zip(given.items(), slopes, strict=True):
        assert slope.isfinite().all(), name
        way = torch.randn(x.shape, generator=generator, dtype=F64)
        way = way / way.norm()
        with torch.no_grad():
            above, below = (answer({**given, name: x + h * way}) for h in (STEP, -STEP))
        expected = float(above - below) / (2 * STEP)
        assert float((slope * way).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7 * size), (
            name
        )


def _rows(crossing: Crossing, parallel: bool) -> Tensor:
    """Stretches from face to face, one that begins inside, one that ends inside, and two between
    parallel faces where there are any.

    The last not for stochastic surfaces: the middle lies on the ridge of f, which has no derivative
    there by ends that move off their faces (bodies and paths never move so).
    """
    tilt = (crossing.normal_start + crossing.normal_end).abs().amax(-1)
    whole = crossing.normal_start.any(-1) & crossing.normal_end.any(-1)
    across = torch.nonzero(whole & (tilt > 0.1)).squeeze(-1)[:2]
    layers = torch.nonzero(tilt < 1e-12).squeeze(-1)[: 2 * parallel]
    return torch.cat([across, torch.tensor([3, 7]), layers])
