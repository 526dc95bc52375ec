"""Complex field vectors along paths: what is sent as theta and as phi, from vertex to vertex.

The field is kept in columns, real and imaginary parts apart: [re/im, sent, f, p] for each of x, y, z.
A mirror and a crossing act by their TE and TM coefficients directly (``acting.dyad_of`` says what
they do; the tests hold one against the other); other mechanisms bring a dyad.
"""

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from rfsg.tracer.acting import Acting, crossing_normal
from rfsg.tracer.columns import Columns, chosen, columns, cross, dot, moved
from rfsg.tracer.implicit import transverse
from rfsg.tracer.mechanisms import DYAD
from rfsg.tracer.passages import Passages
from rfsg.tracer.records import Act

STRAIGHT = 1e-20  # squared sine of incidence below which there is no plane of incidence


def transported(
    at: Acting,
    through: Passages,
    sent: Float[Tensor, "p 2 3"],
    heard: Float[Tensor, "p 2 3"],
) -> Complex[Tensor, "p f 2 2"]:
    """From (theta, phi) sent to (theta, phi) heard, without spreading; the bases are rows."""
    wave = Wave(at, sent)
    transmission = None
    if len(through.path):
        transmission = at.world.transmission(
            through.which, through.crossing, at.frequency, through.last
        )
    for level in range(at.paths.which.shape[1] + 1):
        if transmission is not None:
            here = torch.nonzero(through.segment == level).squeeze(-1)
            for slot in slots(through.path[here]) if len(here) else ():
                wave.cross(through, here[slot], level, transmission)
        if level < at.paths.which.shape[1]:
            for i, act in at.vertices(level):
                wave.meet(i, act, level)
    return wave.heard(heard)


def slots(path: Int[Tensor, "m"]) -> list[Tensor]:
    """The k-th entries of every path, for k = 0, 1, ...: each list names a path at most once."""
    order = torch.argsort(path, stable=True)
    first = torch.ones(len(path), dtype=torch.bool, device=path.device)
    first[1:] = path[order][1:] != path[order][:-1]
    number = torch.arange(len(path), device=path.device)
    rank = number - torch.cummax(torch.where(first, number, 0), 0).values
    return [order[rank == k] for k in range(int(rank.max()) + 1)]


class Wave:
    """The field on its way along the paths of ``at``."""

    def __init__(self, at: Acting, sent: Float[Tensor, "p 2 3"]):
        self.at = at
        shape = (2, 2, len(at.frequency), len(sent))
        real = sent.permute(2, 1, 0)[:, None, :, None]  # [3 1 sent 1 p]
        zero = torch.zeros_like(real)
        self.field = [
            torch.cat([r, z]).expand(shape) for r, z in zip(real, zero, strict=True)
        ]  # x, y, z

    def meet(self, i: Int[Tensor, "m"], act: Act, level: int) -> None:
        """Let the paths ``i`` pass their vertex."""
        at = self.at
        if act is not Act.REFLECT:
            self._put(i, _multiplied(DYAD[act](at, i, level), self._taken(i)))
            return
        which, contact = at.contact(i, level)
        pair = at.world.reflection(which, contact, at.frequency)
        incoming, outgoing = columns(contact.incoming), columns(contact.outgoing)
        normal = columns(contact.normal)
        self._put(i, acted(pair, incoming, outgoing, normal, self._taken(i)))

    def cross(
        self, through: Passages, i: Int[Tensor, "m"], level: int, transmission: Tensor
    ) -> None:
        """Let paths pass stretches ``i`` of what they go through, each path at most one."""
        path, ends = through.path[i], through.crossing
        direction = self.at.u[path, level]
        normal = crossing_normal(direction, ends.normal_start[i], ends.normal_end[i])
        along = columns(direction)
        self._put(path, acted(transmission[i], along, along, columns(normal), self._taken(path)))

    def heard(self, basis: Float[Tensor, "p 2 3"]) -> Complex[Tensor, "p f 2 2"]:
        rows = [tuple(basis[:, a].T.contiguous()) for a in (0, 1)]
        x, y, z = self.field
        both = torch.stack([r[0] * x + r[1] * y + r[2] * z for r in rows])  # [heard re/im sent f p]
        return torch.complex(both[:, 0], both[:, 1]).permute(3, 2, 0, 1)

    def _taken(self, i: Tensor) -> list[Tensor]:
        if len(i) == self.field[0].shape[-1]:
            return self.field  # every path, and ``i`` is in order
        return [e.index_select(-1, i) for e in self.field]

    def _put(self, i: Tensor, field: list[Tensor]) -> None:
        if len(i) == self.field[0].shape[-1]:
            self.field = field
        else:
            old = (e.contiguous() for e in self.field)
            self.field = [a.index_copy(-1, i, b) for a, b in zip(old, field, strict=True)]


def acted(
    pair: Complex[Tensor, "m f 2"],
    incoming: Columns,
    outgoing: Columns,
    normal: Columns,
    field: list[Tensor],
) -> list[Tensor]:
    """The dyad of ``acting.dyad_of`` on fields [re/im, sent, f, m], without building it."""
    e = _across(incoming, normal)
    p_in = cross(e, incoming)
    back = dot(incoming, normal) * dot(outgoing, normal) < 0
    mirrored = moved(p_in, -2.0 * dot(p_in, normal), normal)
    onward = cross(e, outgoing) if not bool(back.all()) else mirrored
    p_out = chosen(back, mirrored, onward)
    te, tm = torch.view_as_real(pair).permute(2, 3, 1, 0).contiguous()  # each [re/im f m]
    x, y, z = field
    s = _product(te, e[0] * x + e[1] * y + e[2] * z)
    p = _product(tm, p_in[0] * x + p_in[1] * y + p_in[2] * z)
    return [a * s + b * p for a, b in zip(e, p_out, strict=True)]


def _across(incoming: Columns, normal: Columns) -> Columns:
    """The unit vector across the plane of incidence; any one where there is none."""
    e = cross(incoming, normal)
    straight = dot(e, e) < STRAIGHT
    if bool(straight.any()):
        any_one = columns(transverse(torch.stack(incoming, -1))[:, 0])
        e = chosen(straight, any_one, e)
    inverse = torch.rsqrt(dot(e, e))
    return e[0] * inverse, e[1] * inverse, e[2] * inverse


def _product(coefficient: Float[Tensor, "2 f m"], amplitude: Float[Tensor, "2 k f m"]) -> Tensor:
    """Complex products, real and imaginary parts apart."""
    (a, b), (x, y) = coefficient, amplitude
    return torch.stack([a * x - b * y, a * y + b * x])


def _multiplied(dyad: Complex[Tensor, "m f 3 3"], field: list[Tensor]) -> list[Tensor]:
    parts = torch.stack(field)  # [xyz re/im sent f m]
    whole = torch.complex(parts[:, 0], parts[:, 1]).permute(3, 2, 0, 1)
    after = torch.view_as_real(dyad @ whole)
    return list(after.permute(2, 4, 3, 1, 0).contiguous())
