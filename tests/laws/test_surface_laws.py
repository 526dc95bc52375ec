"""Laws of every surface of the catalogue on every shape, on random contacts and crossings.

10^4 of each in the slow tests, a fifth of that in the others.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing, Shape
from rfsg.objects.physics.transport import LAWS
from rfsg.objects.surfaces.stochastic import INTERFACES, StochasticSurface
from rfsg.scene.assets import load_asset, save_asset
from tests.laws.catalogue import (
    F64,
    FEW,
    FREQUENCY,
    MANY,
    SHAPES,
    SURFACES,
    chords,
    contacts,
    made,
    names,
    reversed_contact,
    reversed_crossing,
    some,
)

EVERY_SHAPE = pytest.mark.parametrize("shape", names(SHAPES))
EVERY_COUNT = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
EVERY_SURFACE = pytest.mark.parametrize("surface", names(SURFACES))
# ways through between parallel faces, where R and T belong to one passage of one plane wave
PARALLEL = pytest.mark.parametrize("shape", ["box", "box-sheet", "cylinder"])
# all but the paper's own interface, which lets R and T exceed 1 together
CONSERVING = pytest.mark.parametrize(
    "surface", [n for n in names(SURFACES) if n != "stochastic-literal"]
)


@dataclass(frozen=True)
class Answers:
    """R, T, diffuse amplitude [n f 2] and excess delay [n f] of a body, and of reversed waves."""

    body: Body
    contact: Contact
    crossing: Crossing
    r: Tensor
    t: Tensor
    delay: Tensor
    back: tuple[Tensor, Tensor, Tensor]


@cache
@torch.no_grad()
def answers(shape: str, surface: str, count: int) -> Answers:
    # a trained network is a hundred times dearer than all others
    count = count // 10 if shape == "neural-cabinet" else count
    form, crossing = chords(shape, count)
    _, contact = contacts(shape, count)
    body = Body(form, made(SURFACES, surface))
    there, back = (
        (
            body.reflection(k, FREQUENCY),
            body.transmission(c, FREQUENCY),
            body.excess_delay(c, FREQUENCY),
        )
        for k, c in ((contact, crossing), (reversed_contact(contact), reversed_crossing(crossing)))
    )
    return Answers(body, contact, crossing, *there, back)


@EVERY_COUNT
@EVERY_SURFACE
@EVERY_SHAPE
def test_nothing_amplifies(shape, surface, count):
    a = answers(shape, surface, count)
    for answer in (a.r, a.t):
        assert answer.shape == (*a.contact.point.shape[:1], len(FREQUENCY), 2)
        assert answer.isfinite().all()
        assert float(answer.abs().max()) <= 1 + 1e-12
    assert a.delay.isfinite().all()
    assert a.body.surface.opaque == bool((a.t == 0).all())


@EVERY_COUNT
@EVERY_SURFACE
@EVERY_SHAPE
def test_reversed_waves_meet_the_same(shape, surface, count):
    """A crossing from y to x does what one from x to y does; a contact likewise."""
    a = answers(shape, surface, count)
    for there, back in zip((a.r, a.t, a.delay), a.back, strict=True):
        assert torch.equal(there, back)


def _through(shape: str) -> tuple[Shape, Crossing]:
    """Stretches between parallel faces."""
    form, c = chords(shape, MANY)
    whole = c.normal_start.any(-1) & ((c.normal_start + c.normal_end).abs().amax(-1) < 1e-12)
    return form, some(c, torch.nonzero(whole).squeeze(-1))


@CONSERVING
@PARALLEL
def test_what_is_reflected_does_not_come_through(shape, surface):
    """|R|^2 + |D|^2 + |T|^2 <= 1 of a plane wave through parallel faces: mirror, diffuse, through."""
    form, c = _through(shape)
    body = Body(form, made(SURFACES, surface))
    assert len(c.start) > 300
    down = (c.end - c.start) / (c.end - c.start).norm(dim=-1, keepdim=True)
    up = down - 2 * (down * c.normal_start).sum(-1, keepdim=True) * c.normal_start
    met = Contact(c.start, down, up, c.normal_start)
    with torch.no_grad():
        power = body.reflection(met, FREQUENCY).abs() ** 2
        power = power + body.transmission(c, FREQUENCY).abs() ** 2
        if body.scattering is not None:
            power = power + body.diffuse(met, FREQUENCY).abs() ** 2
    assert float(power.max()) <= 1 + 1e-12


@EVERY_SURFACE
def test_energy_over_the_hemisphere(surface):
    """Mirror and lobe together send back no more than came: |R|^2 + |D|^2 integral of p <= 1.

    The lobes are polynomials of the direction: Gauss's nodes in the height, even ones around,
    integrate them exactly.
    """
    form, contact = contacts("box")
    body, contact = Body(form, made(SURFACES, surface)), some(contact, slice(200))
    power = body.reflection(contact, FREQUENCY).abs() ** 2
    rough = body.scattering
    if rough is None:
        assert surface.partition("-")[2] not in ("rough", "split")
    else:
        height, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(16))
        height, weight = 0.5 * (1 + height), 0.5 * weight
        turn = torch.arange(32, dtype=F64) * (2 * math.pi / 32)
        sine = (1 - height**2).sqrt()
        flat = [sine[:, None] * turn.cos(), sine[:, None] * turn.sin()]
        local = torch.stack([*flat, height[:, None].expand_as(flat[0])], -1).reshape(-1, 3)
        n = contact.normal
        side = torch.linalg.cross(n, n.roll(1, -1))  # a box's normal is an axis
        frame = torch.stack([side, torch.linalg.cross(n, side), n], 1)
        out = torch.einsum("qi,mij->mqj", local, frame)
        each = torch.broadcast_tensors(contact.incoming[:, None], out, n[:, None])
        solid_angle = (weight[:, None] * (2 * math.pi / 32)).expand(-1, 32).reshape(-1)
        share = (rough.density(*each) * solid_angle).sum(1)
        head_on = (contact.incoming * n).sum(-1).abs() > 1e-5
        torch.testing.assert_close(share[head_on], torch.ones_like(share)[head_on])
        power = power + body.diffuse(contact, FREQUENCY).abs() ** 2 * share[:, None, None]
    assert float(power.detach().max()) <= 1 + 1e-12


@EVERY_SURFACE
@PARALLEL
def test_the_group_delay_is_the_slope_of_the_phase(shape, surface):
    """tau = -(1 / 2 pi) d arg T_TE / df, by central differences."""
    form, c = _through(shape)
    body, c, h = Body(form, made(SURFACES, surface)), some(c, slice(300)), 1e-7
    with torch.no_grad():
        delay = body.excess_delay(c, FREQUENCY)
        here, above, below = (
            body.transmission(c, FREQUENCY * (1 + x))[..., 0] for x in (0.0, h, -h)
        )
    heard = here.abs() > 1e-150
    assert body.surface.opaque or int(heard.sum()) > 300
    slope = (above * below.conj()).angle() / (2 * h * FREQUENCY)
    found, expected = delay[heard], -slope[heard] / (2 * math.pi)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-17)


@EVERY_SURFACE
@pytest.mark.parametrize("shape", ["box", "neural"])
def test_each_frequency_and_each_wave_alone(shape, surface):
    """The frequency axis is a loop, and so is the batch, in whatever form it comes."""
    form, crossing = chords(shape)
    _, contact = contacts(shape)
    body = Body(form, made(SURFACES, surface))
    contact, crossing = some(contact, slice(12)), some(crossing, slice(12))

    @torch.no_grad()
    def ask(k: Contact, c: Crossing, frequency: Tensor) -> list[Tensor]:
        return [
            body.reflection(k, frequency),
            body.transmission(c, frequency),
            body.excess_delay(c, frequency) * 1e9,
        ]

    whole = ask(contact, crossing, FREQUENCY)
    by_frequency = zip(*(ask(contact, crossing, f) for f in FREQUENCY.split(1)), strict=True)
    rows = (slice(i, i + 1) for i in range(12))
    by_row = zip(*(ask(some(contact, i), some(crossing, i), FREQUENCY) for i in rows), strict=True)
    folds = torch.arange(12).reshape(3, 4)
    folded = ask(some(contact, folds), some(crossing, folds), FREQUENCY)
    for one, each, alone, other in zip(whole, by_frequency, by_row, folded, strict=True):
        for same in (torch.cat(each, 1), torch.cat(alone), other.reshape(one.shape)):
            torch.testing.assert_close(same, one, rtol=1e-10, atol=1e-12)


SHARPNESS = (1e-3, 1.0, 1e3, 1e6)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("m", [0.0, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_a_stochastic_surface_is_passive_at_its_ends(shape, m, alpha):
    form, crossing = chords(shape)
    _, contact = contacts(shape)
    contact, crossing = some(contact, slice(60)), some(crossing, slice(60))
    for k, sharpness in enumerate(SHARPNESS):
        surface = StochasticSurface(
            m=m,
            alpha=alpha,
            sharpness=sharpness,
            phi=(-1) ** k * math.pi / 2,
            bulk=(None, 0.0, 1e3, 1e6)[k],
            law=sorted(LAWS)[k % 3],
            interface=INTERFACES[0],
            samples=4,
        ).with_numerics(4, "telescoped", diffuse=k % 2 == 0)
        with torch.no_grad():
            r = surface.reflection(form, contact, FREQUENCY)
            d = surface.diffuse(form, contact, FREQUENCY) if surface.splits else 0.0 * r
            t = surface.transmission(form, crossing, FREQUENCY)
            back = surface.transmission(form, reversed_crossing(crossing), FREQUENCY)
        assert r.isfinite().all() and t.isfinite().all() and d.isfinite().all()
        assert float((r.abs() ** 2 + d.abs() ** 2).max()) <= 1 + 1e-12
        assert float(t.abs().max()) <= 1 and torch.equal(t, back)


@EVERY_SURFACE
@EVERY_SHAPE
def test_what_is_saved_is_what_is_loaded(shape, surface, tmp_path):
    """Bit for bit the same answers from the file."""
    count = FEW // 10 if shape == "neural-cabinet" else FEW
    (form, crossing), (_, contact) = chords(shape, count), contacts(shape, count)
    contact, crossing = some(contact, slice(10)), some(crossing, slice(10))
    body = Body(form, made(SURFACES, surface))
    loaded = load_asset(save_asset(tmp_path / "it", body)).body
    if isinstance(body.surface, StochasticSurface):  # how it is asked is not part of the object
        assert isinstance(loaded.surface, StochasticSurface)
        loaded.surface.splits = body.surface.splits
    with torch.no_grad():
        for ask in ("reflection", "transmission", "excess_delay"):
            met = contact if ask == "reflection" else crossing
            a, b = (getattr(x, ask)(met, FREQUENCY) for x in (body, loaded))
            assert torch.equal(a, b)
        assert torch.equal(form.sdf(crossing.start), loaded.shape.sdf(crossing.start))
    assert loaded.shape.config() == form.config()
    assert loaded.surface.config() == body.surface.config()
