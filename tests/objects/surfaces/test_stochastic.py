"""The learned surface: closed forms of the paper's model, laws, gradients, extremes."""

import json
import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from rfsg.objects.contract import Contact, Crossing, Surface
from rfsg.objects.physics.transport import LAWS
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.surfaces import stochastic
from rfsg.objects.surfaces.stochastic import StochasticSurface
from tests.objects.surfaces.surface_scenes import chords, contacts, ground, reverse, through_wall

F64 = torch.float64
FREQUENCY = torch.tensor([2.4e9, 28e9], dtype=F64)


def lively(seed: int = 0, **arguments) -> StochasticSurface:
    """A surface whose fields vary from point to point, as after a fit."""
    torch.manual_seed(seed)
    surface = StochasticSurface(**arguments)
    torch.nn.init.normal_(surface.head_weight, std=0.1)
    return surface


VARIANTS = [
    {},
    {"law": "gaussian", "bulk": 2.0, "phi": 0.6},
    {"law": "laplace", "interface": "paper", "phi": -1.5},
    {"integral": "riemann", "alpha": 0.2},
]


def test_satisfies_the_contract():
    assert isinstance(StochasticSurface(), Surface)


@pytest.mark.parametrize("arguments", VARIANTS)
def test_is_passive(arguments):
    surface = lively(**arguments)
    with torch.no_grad():
        r = surface.reflection(*contacts(), FREQUENCY)
        t = surface.transmission(*chords(), FREQUENCY)
    assert r.shape == t.shape == (1000, 2, 2)
    for x in (r, t):
        assert x.isfinite().all() and 0 < x.abs().max() <= 1
    assert torch.equal(r[..., 0], r[..., 1])  # one scalar model for TE and TM


@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("depth", [1.0, 30.0])
@pytest.mark.parametrize("cosine", [1.0, 0.3])
def test_a_thick_object_transmits_a_quarter(law, depth, cosine):
    """|T| = e^{-m} / 4 whatever the thickness and angle: m (1/2 + 1/2) + 2 ln 2 (alpha = 1)."""
    surface = StochasticSurface(
        m=1.3, alpha=1.0, sharpness=300.0, law=law, interface="paper", samples=8
    )
    t = surface.transmission(*through_wall(depth, cosine), FREQUENCY)
    expected = 0.25 * math.exp(-1.3)
    assert t.real.flatten().tolist() == pytest.approx([expected] * 4, rel=1e-11)


@pytest.mark.parametrize("law", sorted(LAWS))
def test_a_thin_wall_follows_its_occupancy(law):
    """integral sigma_in = 2 (m |delta o| + |delta ln o|) from the face to the middle (Eq. 13)."""
    surface = StochasticSurface(m=0.7, alpha=1.0, sharpness=5.0, law=law, interface="paper")
    t = surface.transmission(*through_wall(0.2), FREQUENCY)
    o = float(LAWS[law].occupancy(torch.tensor(-0.1 * 5.0, dtype=F64)))
    expected = math.exp(-2 * (0.7 * (o - 0.5) + math.log(2 * o)))
    assert t.real.flatten().tolist() == pytest.approx([expected] * 4, rel=1e-11)


def test_the_steps_do_not_change_the_physics():
    a, b = (StochasticSurface(alpha=0.5, samples=n) for n in (64, 128))
    b.load_state_dict(a.state_dict())
    shape, crossing = chords(50)
    ta, tb = (x.transmission(shape, crossing, FREQUENCY) for x in (a, b))
    torch.testing.assert_close(ta, tb, rtol=5e-3, atol=1e-6)


def test_reflection_in_closed_form():
    """R = exp(-(m/2 + 1) (s/2) sigma_mix e^{j phi} ell) on f = 0, |grad f| = 1 (Eqs. 14, 16)."""
    surface = StochasticSurface(m=2.0, alpha=0.6, phi=0.4, sharpness=50.0, interaction_length=0.03)
    shape, contact = contacts(200)
    cosine = (contact.incoming * contact.normal).sum(-1).abs()
    on_surface = surface.reflection(ground(), _on_ground(contact), FREQUENCY)
    sigma = (2.0 / 2 + 1) * 25.0 * (0.6 * cosine + 0.2)
    phase = torch.polar(torch.ones_like(sigma), torch.full_like(sigma, 0.4))
    expected = (-sigma * phase * 0.03).exp()
    torch.testing.assert_close(on_surface[:, 0, 0], expected, rtol=1e-12, atol=0)
    # The sphere's rounding leaves |f| ~ 1e-16 m: outside or inside, the answer is the boundary's.
    near = surface.reflection(shape, contact, FREQUENCY)
    torch.testing.assert_close(near[:, 0, 0], expected, rtol=1e-12, atol=0)


def _on_ground(contact: Contact) -> Contact:
    """The same angles on the plane z = 0 (only |omega . normal| matters to the model)."""
    return replace(contact, point=torch.zeros_like(contact.point))


def test_a_vertex_inside_counts_as_on_the_boundary():
    surface = StochasticSurface(sharpness=1e6)
    _, contact = contacts(20)
    flat = _on_ground(contact)
    below = replace(flat, point=flat.point - torch.tensor([0.0, 0.0, 1e-3], dtype=F64))
    r, r_below = (surface.reflection(ground(), c, FREQUENCY) for c in (flat, below))
    assert torch.equal(r, r_below)


def test_conserving_interface_keeps_energy():
    """|R|^2 + |t|^2 = 1 at each boundary: T(conserving) / T(paper) = 1 - |R|^2 with equal faces."""
    literal = StochasticSurface(interface="paper")
    conserving = StochasticSurface(interface="conserving")
    conserving.load_state_dict(literal.state_dict())
    box, crossing = through_wall(0.1, 0.5)
    ratio = conserving.transmission(box, crossing, FREQUENCY) / literal.transmission(
        box, crossing, FREQUENCY
    )
    mirror = crossing.normal_start * torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    travel = torch.nn.functional.normalize(crossing.end - crossing.start, dim=-1)
    bounce = travel - 2 * (travel * mirror).sum(-1, keepdim=True) * mirror
    contact = Contact(crossing.start, travel, bounce, crossing.normal_start)
    r = conserving.reflection(box, contact, FREQUENCY)
    torch.testing.assert_close(ratio.real, 1 - r.abs() ** 2, rtol=1e-12, atol=0)


def test_an_end_inside_has_no_boundary():
    literal = StochasticSurface(interface="paper")
    conserving = StochasticSurface(interface="conserving")
    conserving.load_state_dict(literal.state_dict())
    box, crossing = through_wall(0.4)
    middle = replace(crossing, end=0.2 * crossing.end, normal_end=torch.zeros_like(crossing.end))
    buried = replace(middle, start=-middle.end, normal_start=middle.normal_end)
    ratio = [
        (conserving.transmission(box, c, FREQUENCY) / literal.transmission(box, c, FREQUENCY))
        for c in (crossing, middle, buried)
    ]
    torch.testing.assert_close(ratio[0], ratio[1] ** 2, rtol=1e-12, atol=0)
    torch.testing.assert_close(ratio[2], torch.ones_like(ratio[2]), rtol=1e-12, atol=0)


def test_bulk_loss_grows_with_thickness():
    """kappa = 3 Np/m through a solid 1 m thick: e^{-3} on top (occupancy below 1 costs < 1 %)."""
    plain, bulk = (StochasticSurface(bulk=k, sharpness=2e3, samples=400) for k in (None, 3.0))
    wall = through_wall(1.0)
    ratio = bulk.transmission(*wall, FREQUENCY) / plain.transmission(*wall, FREQUENCY)
    assert ratio.real.flatten().tolist() == pytest.approx([math.exp(-3)] * 4, rel=1e-2)


@cache
def network(features: int = 128) -> NeuralShape:
    """Its Lipschitz bound is given, because measuring it takes seconds and is not used here."""
    return NeuralShape([[-1.0] * 3, [1.0] * 3], features=features, lipschitz=2.0)


SHAPES = [lambda: chords(100), lambda: (network(), chords(100)[1])]


@pytest.mark.parametrize("make", SHAPES, ids=["sphere", "neural"])
@pytest.mark.parametrize("samples", [32, 7])
@pytest.mark.parametrize("arguments", VARIANTS[:3])
def test_reversal_changes_nothing(make, samples, arguments):
    surface = lively(samples=samples, **arguments)
    shape, crossing = make()
    with torch.no_grad():
        forward = surface.transmission(shape, crossing, FREQUENCY)
        back = surface.transmission(shape, reverse(crossing), FREQUENCY)
    torch.testing.assert_close(forward, back, rtol=1e-12, atol=0)
    shape, contact = contacts(200)
    turned = Contact(contact.point, -contact.outgoing, -contact.incoming, contact.normal)
    assert torch.equal(
        surface.reflection(shape, contact, FREQUENCY), surface.reflection(shape, turned, FREQUENCY)
    )


def test_fields_start_where_they_are_told():
    surface = StochasticSurface(m=7.0, alpha=0.25, phi=-0.3, bulk=1.5)
    shape, contact = contacts(50)
    m, alpha, phi, kappa = surface.fields(shape, contact.point)
    for field, value in ((m, 7.0), (alpha, 0.25), (phi, -0.3), (kappa, 1.5)):
        torch.testing.assert_close(field, torch.full_like(field, value), rtol=1e-12, atol=0)


@pytest.mark.parametrize("alpha, m, phi", [(0.0, 0.0, math.pi / 2), (1.0, 1e6, -math.pi / 2)])
def test_fields_reach_their_ends(alpha, m, phi):
    surface = StochasticSurface(m=m, alpha=alpha, phi=phi)
    shape, contact = contacts(3)
    fields = surface.fields(shape, contact.point)
    for field, value in zip(fields, (m, alpha, phi), strict=False):
        assert field.tolist() == pytest.approx([value] * 3, rel=1e-12, abs=1e-15)


def test_features_of_the_shape_reach_the_fields():
    surface, point = lively(), contacts(20)[1].point
    shape = network()
    fused = surface._sample(shape, point).fields
    torch.testing.assert_close(fused.m, surface.fields(shape, point).m, rtol=1e-12, atol=1e-14)
    plain = surface._network(shape, point, None)
    assert (fused.m - plain.m).abs().max() > 1e-6
    narrow = network(16)
    with pytest.raises(ValueError, match="expected 128 features.*got 16"):
        surface.fields(narrow, point)


def test_chunks_change_nothing(monkeypatch):
    surface = lively()
    shape, crossing = chords(40)
    whole = surface.transmission(shape, crossing, FREQUENCY)
    monkeypatch.setattr(stochastic, "CHUNK", 100)
    with torch.no_grad():
        parts = surface.transmission(shape, crossing, FREQUENCY)
    torch.testing.assert_close(parts, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("arguments", VARIANTS)
def test_is_rebuilt_from_config_and_state(arguments):
    surface = lively(**arguments)
    twin = StochasticSurface(**json.loads(json.dumps(surface.config())))
    twin.load_state_dict(surface.state_dict())
    wall = chords(10)
    assert torch.equal(twin.transmission(*wall, FREQUENCY), surface.transmission(*wall, FREQUENCY))


def test_float32_to_search_float64_to_evaluate():
    surface = lively()
    shape, crossing = chords(50)
    narrow = Crossing(*(x.float() for x in vars(crossing).values()))
    t = surface.transmission(shape, narrow, FREQUENCY)
    assert t.dtype == torch.complex64
    wide = surface.transmission(shape, crossing, FREQUENCY)
    assert wide.dtype == torch.complex128
    torch.testing.assert_close(t, wide.to(torch.complex64), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("arguments", VARIANTS)
def test_gradcheck_of_points_and_object_parameters(arguments):
    surface = lively(samples=4, interaction_length=0.02, **arguments)
    shape, contact = contacts(2)
    _, crossing = through_wall(0.3, 0.7)
    box = through_wall(0.3, 0.7)[0]
    # Off the boundary: on it |f| has the kink that max(f, 0) stands for.
    point = (contact.point * 1.05).requires_grad_()
    end = crossing.end.clone().requires_grad_()

    def run(point, end, *parameters):
        names = ("log_sharpness", "log_interaction_length", "head_bias")
        with _replaced(surface, dict(zip(names, parameters, strict=True))):
            r = surface.reflection(shape, replace(contact, point=point), FREQUENCY)
            t = surface.transmission(box, replace(crossing, end=end), FREQUENCY)
        return torch.view_as_real(r[:, 0, 0]), torch.view_as_real(t[:, 0, 0])

    own = (surface.log_sharpness, surface.log_interaction_length, surface.head_bias)
    inputs = (point, end, *(x.detach().clone().requires_grad_() for x in own))
    assert torch.autograd.gradcheck(run, inputs)


class _replaced:
    """Stand tensors in for parameters of a module for a while."""

    def __init__(self, module, values):
        self.module, self.values = module, values

    def __enter__(self):
        self.kept = {name: self.module._parameters.pop(name) for name in self.values}
        for name, value in self.values.items():
            object.__setattr__(self.module, name, value)

    def __exit__(self, *_):
        for name, parameter in self.kept.items():
            object.__delattr__(self.module, name)
            self.module._parameters[name] = parameter


def test_every_parameter_gets_a_gradient_once_it_moves():
    surface = lively(bulk=1.0)
    shape = network()
    _, crossing = chords(20)
    surface.transmission(shape, crossing, FREQUENCY).abs().sum().backward()
    for name, parameter in surface.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name
    fresh = StochasticSurface()
    fresh.transmission(shape, crossing, FREQUENCY).abs().sum().backward()
    assert fresh.head_weight.grad.abs().max() > 0


@pytest.mark.parametrize("integral", ["telescoped", "riemann"])
@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("s", [1e-3, 1e6])
@pytest.mark.parametrize("m, phi", [(0.0, math.pi / 2), (1e6, 0.0)])
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_extremes(integral, law, s, m, phi, dtype):
    """Tiny and huge, grazing, a stretch of no length, both ends inside: finite everywhere."""
    surface = StochasticSurface(
        m=m, phi=phi, sharpness=s, law=law, integral=integral, bulk=0.0, samples=4
    )
    for depth in (1e-3, 1e3):
        for cosine in (1.0, 1e-4):
            box, crossing = through_wall(depth, cosine, dtype)
            zero = torch.zeros_like(crossing.start)
            nothing = replace(crossing, end=crossing.start)
            for c in (crossing, nothing, replace(crossing, normal_start=zero, normal_end=zero)):
                c = replace(c, end=c.end.clone().requires_grad_())
                t = surface.transmission(box, c, FREQUENCY)
                assert t.isfinite().all() and t.abs().max() <= 1
                surface.zero_grad()
                (t.real.sum() + t.imag.sum()).backward()
                assert c.end.grad.isfinite().all()
                assert all(
                    p.grad.isfinite().all() for p in surface.parameters() if p.grad is not None
                )


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"m": -1.0}, "m: expected a number >= 0, got -1.0"),
        ({"alpha": 1.5}, "alpha"),
        ({"phi": 2.0}, "phi"),
        ({"sharpness": 0.0}, "sharpness"),
        ({"interaction_length": 0.0}, "interaction_length"),
        ({"bulk": -1.0}, "bulk"),
        ({"law": "cauchy"}, "law.*cauchy"),
        ({"interface": "leaky"}, "interface.*leaky"),
        ({"integral": "simpson"}, "integral.*simpson"),
        ({"samples": 0}, "samples"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        StochasticSurface(**arguments)


def test_an_empty_batch_is_answered():
    surface = StochasticSurface(bulk=1.0)
    shape, crossing = chords(3)
    none = Crossing(*(x[:0] for x in vars(crossing).values()))
    with torch.no_grad():
        assert surface.transmission(shape, none, FREQUENCY).shape == (0, 2, 2)
