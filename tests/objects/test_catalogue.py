"""Every kind that files may name leads to a class that keeps its contract."""

import json
import math

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.catalogue import SHAPES, SURFACES, shape_class, surface_class
from rfsg.objects.contract import Contact, Crossing, Shape, Surface
from tests.laws import catalogue as examples


def make_shape(kind: str):
    return next(iter(examples.SHAPES[kind].values()))()


def make_surface(kind: str):
    return next(iter(examples.SURFACES[kind].values()))()


def test_every_kind_has_an_example_that_the_laws_are_tried_on():
    for known, table in ((SHAPES, examples.SHAPES), (SURFACES, examples.SURFACES)):
        assert known.keys() == table.keys()
        for kind, some in table.items():
            assert some and {make().kind for make in some.values()} == {kind}


@pytest.mark.parametrize(
    ("make", "kind", "contract"),
    [(make_shape, k, Shape) for k in SHAPES] + [(make_surface, k, Surface) for k in SURFACES],
)
def test_a_kind_keeps_its_contract_and_is_made_again_from_its_config(make, kind, contract):
    part = make(kind)
    assert isinstance(part, torch.nn.Module) and isinstance(part, contract)
    assert part.kind == kind
    again = type(part)(**json.loads(json.dumps(part.config()))).config()
    assert again.keys() == part.config().keys()
    for name, value in part.config().items():
        assert _close(again[name], value), name


def _close(a, b) -> bool:
    """Equal, but for the rounding of what is kept as a logarithm."""
    if isinstance(b, list):
        return len(a) == len(b) and all(map(_close, a, b))
    if isinstance(b, dict):
        return a.keys() == b.keys() and all(_close(a[name], b[name]) for name in b)
    return math.isclose(a, b, rel_tol=1e-12) if isinstance(b, float) else a == b


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("shape", SHAPES)
def test_every_surface_answers_on_every_shape(shape, surface):
    """|R| and |T| at most 1, of the declared form, whatever is joined with what."""
    body = Body(make_shape(shape), make_surface(surface))
    point, normal = (
        torch.tensor([[0.0, 0.0, 0.3]]).double(),
        torch.tensor([[0.0, 0.0, 1.0]]).double(),
    )
    down = torch.tensor([[0.6, 0.0, -0.8]]).double()
    frequency = torch.tensor([2.4e9, 5.8e9]).double()
    r = body.reflection(
        Contact(point, down, down * torch.tensor([1.0, 1.0, -1.0]), normal), frequency
    )
    crossing = Crossing(point, point + 0.2 * down, normal, -normal)
    t, excess = body.transmission(crossing, frequency), body.excess_delay(crossing, frequency)
    assert r.shape == t.shape == (1, 2, 2) and excess.shape == (1, 2)
    assert bool((r.abs() <= 1 + 1e-12).all()) and bool((t.abs() <= 1 + 1e-12).all())
    assert bool(torch.isfinite(excess).all())


@pytest.mark.parametrize("find", [shape_class, surface_class])
def test_an_unknown_kind_names_the_known_ones(find):
    known = SHAPES if find is shape_class else SURFACES
    with pytest.raises(ValueError, match="'teapot'") as fault:
        find("teapot")
    assert all(kind in str(fault.value) for kind in known)
