"""What each kind of vertex does to the wave: one coefficient, or a dyad on world field vectors.

A dyad maps the field before a vertex to the field after it, without spreading. The scalar coefficient
of an unpolarised link carries the mean power of the two polarisations and the phase of TE.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact
from rfsg.scene.world import World, unit
from rfsg.tracer.edges import Edges
from rfsg.tracer.implicit import transverse
from rfsg.tracer.records import Act, Paths


@dataclass(frozen=True)
class Acting:
    """What every mechanism may ask about the paths it acts on. u: directions of the segments."""

    world: World
    paths: Paths
    u: Float[Tensor, "p s 3"]
    frequency: Float[Tensor, "f"]
    edges: Edges | None

    def vertices(self, level: int) -> Iterator[tuple[Int[Tensor, "m"], Act]]:
        """Paths that have a vertex at a level, by what happens there."""
        here = self.paths.which[:, level] >= 0
        for act in torch.unique(self.paths.act[here, level]).tolist():
            i = torch.nonzero(here & (self.paths.act[:, level] == act)).squeeze(-1)
            yield i, Act(act)

    def contact(self, i: Int[Tensor, "m"], level: int) -> tuple[Int[Tensor, "m"], Contact]:
        """On what, and how, paths meet a face at a level."""
        paths, u = self.paths, self.u
        contact = Contact(
            paths.vertices[i, level + 1], u[i, level], u[i, level + 1], paths.normal[i, level]
        )
        return paths.which[i, level], contact


def scalar(pair: Complex[Tensor, "*b 2"]) -> Complex[Tensor, "*b"]:
    """One coefficient for an unpolarised link: mean power of (TE, TM), phase of TE."""
    te, tm = pair[..., 0], pair[..., 1]
    te_power = te.real**2 + te.imag**2
    power = 0.5 * (te_power + tm.real**2 + tm.imag**2)
    dark = te_power < DARK
    ratio = torch.where(dark, torch.ones_like(power), power / torch.where(dark, 1.0, te_power))
    # without a TE wave there is no phase to take: the TM share alone, in phase
    alone = torch.sqrt(torch.where(dark & (power > DARK), power, torch.ones_like(power)))
    alone = torch.where(dark & (power > DARK), alone, torch.zeros_like(alone)).to(pair.dtype)
    return torch.where(dark, alone, torch.sqrt(ratio) * te)


DARK = 1e-60  # power of -600 dB: nothing


def crossing_normal(
    direction: Float[Tensor, "m 3"],
    normal_start: Float[Tensor, "m 3"],
    normal_end: Float[Tensor, "m 3"],
) -> Float[Tensor, "m 3"]:
    """The normal whose plane of incidence a whole crossing is given: the mean of entry and exit.

    Of parallel faces they are opposed, of a ball's chord they lie on one side of the ray: what they
    have across the ray adds up, not what they have along it. The same backwards.
    """
    first, last = (
        torch.linalg.cross(direction, normal_start),
        torch.linalg.cross(direction, normal_end),
    )
    opposed = ((first * last).sum(-1, keepdim=True) <= 0).to(direction)
    return unit(normal_start + (1.0 - 2.0 * opposed) * normal_end)


def dyad_of(
    pair: Complex[Tensor, "m f 2"],
    incoming: Float[Tensor, "m 3"],
    outgoing: Float[Tensor, "m 3"],
    normal: Float[Tensor, "m 3"],
) -> Complex[Tensor, "m f 3 3"]:
    """E_out = C_te e (e . E) + C_tm p_out (p_in . E), e across the plane of incidence.

    p_in = e x k_in. Where the wave goes back, p_out is the mirror image of p_in: at normal incidence
    the two coefficients then do the same, as the contract says. Where it goes on, p_out = e x k_out.
    """
    e = torch.linalg.cross(incoming, normal)
    straight = (e * e).sum(-1, keepdim=True) < 1e-20
    e = unit(torch.where(straight, transverse(incoming)[:, 0], e))
    p_in = torch.linalg.cross(e, incoming)
    back = ((incoming * normal).sum(-1) * (outgoing * normal).sum(-1) < 0)[:, None]
    mirrored = p_in - 2.0 * (p_in * normal).sum(-1, keepdim=True) * normal
    p_out = torch.where(back, mirrored, torch.linalg.cross(e, outgoing))
    te = e[:, :, None] * e[:, None, :]
    tm = p_out[:, :, None] * p_in[:, None, :]
    return pair[..., 0, None, None] * te[:, None] + pair[..., 1, None, None] * tm[:, None]


def reflection(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f"]:
    """Scalar coefficient of mirrors."""
    which, contact = at.contact(i, level)
    return scalar(at.world.reflection(which, contact, at.frequency))


def reflection_dyad(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f 3 3"]:
    """What mirrors do to world field vectors."""
    which, contact = at.contact(i, level)
    pair = at.world.reflection(which, contact, at.frequency)
    return dyad_of(pair, contact.incoming, contact.outgoing, contact.normal)
