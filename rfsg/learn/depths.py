"""How deep the learned surfaces are that a path goes through or is mirrored by."""

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from rfsg.learn.kept import AT_ONCE, Kept
from rfsg.objects.contract import Contact, Crossing
from rfsg.tracer.implicit import segments
from rfsg.tracer.records import Act

DARKEST = 1e-30  # share of the power below which a coefficient counts as this: it has a logarithm


@torch.no_grad()
def depths(kept: Kept) -> Float[Tensor, "p f"]:
    """Optical depth of every path: -ln of the share of its power that learned surfaces let on.

    Of all stochastic surfaces, with the weights as they are now: what is crossed, and mirrors.
    Vertices and crossings stand where they were found.
    """
    world, through, paths = kept.world, kept.through, kept.paths
    frequency, learned = kept.links.frequency, kept.world.learned_surface
    depth = torch.zeros_like(kept.value.real)
    for i in torch.nonzero(learned[through.which]).squeeze(-1).split(AT_ONCE):
        crossing = Crossing(**{n: t[i] for n, t in vars(through.crossing).items()})
        found = world.transmission(through.which[i], crossing, frequency, through.last[i])
        depth.index_add_(0, through.path[i], _depth(found))
    _, way = segments(paths.vertices)
    for level in range(paths.which.shape[1]):
        which = paths.which[:, level]
        mirror = (which >= 0) & (paths.act[:, level] == int(Act.REFLECT))
        for i in torch.nonzero(mirror & learned[which.clamp(min=0)]).squeeze(-1).split(AT_ONCE):
            at = paths.vertices[i, level + 1], way[i, level], way[i, level + 1]
            contact = Contact(*at, paths.normal[i, level])
            depth.index_add_(0, i, _depth(world.reflection(which[i], contact, frequency)))
    return depth


def _depth(pair: Complex[Tensor, "m f 2"]) -> Float[Tensor, "m f"]:
    """-ln of the mean power of TE and TM, at least 0: nothing amplifies but by rounding."""
    power = pair.to(torch.complex128).abs().square().mean(-1)
    return -power.clamp(min=DARKEST, max=1.0).log()
