"""Conductor, dielectric half-space and slab: formulas, laws, refusals, files."""

import cmath
import json
import math
from dataclasses import replace

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.catalogue import SURFACES, shape_class, surface_class
from rfsg.objects.contract import Contact, RadioObject, Surface
from rfsg.objects.physics import fresnel, media
from rfsg.objects.surfaces.interface import Conductor, Dielectric, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from tests.objects.surfaces.surface_scenes import chords, contacts, reverse, through_wall

F64, C128 = torch.float64, torch.complex128
FREQUENCY = torch.tensor([2.4e9, 28e9], dtype=F64)
KNOWN = [
    Conductor(),
    DielectricHalfSpace("concrete"),
    DielectricHalfSpace(eps_r=4.0, sigma=0.02),
    Slab(0.1, "concrete"),
    Slab(0.006, "glass"),
    Slab(0.02, eps_r=3.0),
]
IDS = [f"{s.kind}-{i}" for i, s in enumerate(KNOWN)]


@pytest.mark.parametrize("surface", KNOWN, ids=IDS)
def test_satisfies_the_contract(surface):
    assert isinstance(surface, Surface)
    assert surface_class(surface.kind) is type(surface)
    shape, contact = contacts(3)
    body = Body(shape, surface)
    assert isinstance(body, RadioObject)
    assert body.reflection(contact, FREQUENCY).shape == (3, 2, 2)
    _, crossing = chords(3)
    assert body.transmission(crossing, FREQUENCY).shape == (3, 2, 2)
    assert body.excess_delay(crossing, FREQUENCY).shape == (3, 2)


@pytest.mark.parametrize("surface", KNOWN, ids=IDS)
def test_is_passive_and_reciprocal(surface):
    shape, contact = contacts()
    r = surface.reflection(shape, contact, FREQUENCY)
    assert r.isfinite().all() and r.abs().max() <= 1 + 1e-12
    back = Contact(contact.point, -contact.outgoing, -contact.incoming, contact.normal)
    assert torch.equal(surface.reflection(shape, back, FREQUENCY), r)
    shape, crossing = chords()
    t = surface.transmission(shape, crossing, FREQUENCY)
    assert t.isfinite().all() and t.abs().max() <= 1 + 1e-12
    assert torch.equal(surface.transmission(shape, reverse(crossing), FREQUENCY), t)
    delay = surface.excess_delay(shape, crossing, FREQUENCY)
    assert delay.isfinite().all()
    assert torch.equal(surface.excess_delay(shape, reverse(crossing), FREQUENCY), delay)


@pytest.mark.parametrize("surface", KNOWN, ids=IDS)
def test_is_rebuilt_from_its_config(surface):
    config = json.loads(json.dumps(surface.config()))
    twin = type(surface)(**config)
    twin.load_state_dict(surface.state_dict())
    shape, contact = contacts(5)
    frequency = FREQUENCY
    assert torch.equal(
        twin.reflection(shape, contact, frequency), surface.reflection(shape, contact, frequency)
    )


@pytest.mark.parametrize("surface", KNOWN, ids=IDS)
def test_answers_in_the_precision_of_the_points(surface):
    shape, contact = contacts(4)
    narrow = Contact(*(x.float() for x in vars(contact).values()))
    r = surface.reflection(shape, narrow, FREQUENCY)
    assert r.dtype == torch.complex64
    wide = surface.reflection(shape, contact, FREQUENCY)
    torch.testing.assert_close(r, wide.to(torch.complex64), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("surface", [Conductor(), DielectricHalfSpace("wood")])
def test_nothing_comes_through_an_opaque_surface(surface):
    shape, crossing = chords(10)
    assert surface.opaque
    assert surface.transmission(shape, crossing, FREQUENCY).abs().max() == 0


def test_conductor():
    shape, contact = contacts(10)
    r = Conductor().reflection(shape, contact, FREQUENCY)
    assert torch.equal(r, torch.full((10, 2, 2), -1.0, dtype=C128))


def test_half_space_is_fresnel_at_the_contact_angle():
    shape, contact = contacts(100)
    cosine = (contact.incoming * contact.normal).sum(-1).abs()
    eps = media.complex_permittivity("concrete", FREQUENCY)
    te, tm = fresnel.interface(cosine[:, None], eps)
    r = DielectricHalfSpace("concrete").reflection(shape, contact, FREQUENCY)
    torch.testing.assert_close(r, torch.stack([te, tm], -1), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.1])
@pytest.mark.parametrize("depth", [0.05, 0.1, 0.3])
def test_a_slab_is_as_thick_as_it_says_not_as_drawn(cosine, depth):
    surface = Slab(0.1, "concrete")
    box, crossing = through_wall(depth, cosine)
    t = surface.transmission(box, crossing, FREQUENCY)
    eps = media.complex_permittivity("concrete", FREQUENCY)
    _, expected = fresnel.slab(torch.tensor(cosine, dtype=F64), eps, 0.1, FREQUENCY)
    torch.testing.assert_close(t[0], expected, rtol=1e-9, atol=1e-15)


def test_ends_inside_the_wall_only_change_the_angle():
    surface = Slab(0.1, "plasterboard")
    box, crossing = through_wall(0.1, 0.5)
    whole = surface.transmission(box, crossing, FREQUENCY)
    none = torch.zeros_like(crossing.normal_end)
    half = replace(crossing, normal_end=none)
    torch.testing.assert_close(surface.transmission(box, half, FREQUENCY), whole)
    inside = replace(half, normal_start=none)
    straight = surface.transmission(*through_wall(0.1, 1.0), FREQUENCY)
    torch.testing.assert_close(surface.transmission(box, inside, FREQUENCY), straight)


def test_concrete_delays_by_the_group_index():
    """Echoes die out in a lossy wall: d (Re d(f n)/df - 1)/c is left, n^2 = eps_r - j b/f."""
    f, loss = 10e9, 0.6 / (2 * math.pi * media.VACUUM_PERMITTIVITY)
    delay = Slab(0.1, eps_r=5.24, sigma=0.6).excess_delay(
        *through_wall(0.1), torch.tensor([f], dtype=F64)
    )
    n = cmath.sqrt(5.24 - 1j * loss / f)
    group = n + 1j * loss / (2 * f * n)
    assert delay.item() == pytest.approx(0.1 * (group.real - 1) / fresnel.SPEED_OF_LIGHT, rel=1e-3)
    assert delay.item() == pytest.approx(0.43e-9, rel=0.02)  # what peers leave out


def test_constants_can_be_learned():
    surface = Slab(0.1, eps_r=4.0, sigma=0.05)
    assert [n for n, p in surface.named_parameters() if p.requires_grad] == []
    surface.requires_grad_(True)
    box, crossing = through_wall(0.1, 0.6)
    shape, contact = contacts(2)

    def run(eps_r, sigma):
        names = {"medium.eps_r": eps_r, "medium.sigma": sigma}
        out = [
            torch.func.functional_call(_Call(surface, method), _nest(names), args)
            for method, args in (
                ("reflection", (shape, contact, FREQUENCY)),
                ("transmission", (box, crossing, FREQUENCY)),
            )
        ]
        return tuple(torch.view_as_real(x) for x in out)

    values = [torch.tensor(x, dtype=F64, requires_grad=True) for x in (4.0, 0.05)]
    assert torch.autograd.gradcheck(run, values)


class _Call(torch.nn.Module):
    """One method of a surface as a forward pass, for functional_call."""

    def __init__(self, surface, method):
        super().__init__()
        self.surface, self.method = surface, method

    def forward(self, *arguments):
        return getattr(self.surface, self.method)(*arguments)


def _nest(names):
    return {f"surface.{name}": value for name, value in names.items()}


def test_out_of_band_is_refused_unless_allowed():
    shape, contact = contacts(2)
    high = torch.tensor([60e9], dtype=F64)
    with pytest.raises(ValueError, match="brick.*not for 60 GHz.*extrapolate=True"):
        Slab(0.1, "brick").reflection(shape, contact, high)
    allowed = Slab(0.1, "brick", extrapolate=True)
    assert allowed.reflection(shape, contact, high).isfinite().all()
    assert allowed.config()["extrapolate"] is True


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "either itu=NAME or eps_r"),
        ({"itu": "wood", "eps_r": 2.0}, "either itu=NAME or eps_r"),
        ({"itu": "wood", "sigma": 2.0}, "either itu=NAME or eps_r"),
        ({"itu": "iron"}, "'iron', expected one of vacuum, concrete"),
        ({"eps_r": 0.5}, "eps_r >= 1"),
        ({"eps_r": 2.0, "sigma": -1.0}, "sigma >= 0"),
    ],
)
def test_bad_materials_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Dielectric(**arguments)


def test_bad_thickness_and_unknown_kinds_are_refused():
    with pytest.raises(ValueError, match="thickness in metres > 0, got -0.1"):
        Slab(-0.1, "wood")
    with pytest.raises(ValueError, match="'mirror', expected one of conductor"):
        surface_class("mirror")
    with pytest.raises(ValueError, match="shape kind: got 'cone', expected one of box"):
        shape_class("cone")


@pytest.mark.parametrize("kind", sorted(SURFACES))
def test_every_kind_loads(kind):
    assert surface_class(kind).kind == kind
