"""What an edge does to the wave: coefficients and dyads at DIFFRACT vertices.

World vectors stand in the edge's own frame at each ray, phi-hat towards growing azimuth and beta-hat
= u x phi-hat, where a wave is (soft, hard). With W the 2 x 2 sum of utd's terms and their weights,
E_out = -B_out W B_in^T E_in. A face's (TE, TM) are turned into that frame by the angle between its
plane of incidence and the edge-fixed plane, the mean of both rays': exact on the boundary where the
term belongs to a ray, the same from both ends, and no turn at all for a conductor.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from rfsg.objects.contract import Contact, Crossing
from rfsg.objects.physics import utd
from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.scene.world import unit
from rfsg.tracer.acting import Acting, crossing_normal, scalar
from rfsg.tracer.edges import Edges, along_face
from rfsg.tracer.implicit import segments
from rfsg.tracer.records import Act


@dataclass(frozen=True)
class _Wedge:
    """An edge at a level of some paths, as utd asks it; s are to the next edge or the path's end."""

    edges: Edges
    point: Float[Tensor, "m 3"]
    tangent: Float[Tensor, "m 3"]
    normal0: Float[Tensor, "m 3"]
    normal1: Float[Tensor, "m 3"]
    u_in: Float[Tensor, "m 3"]
    u_out: Float[Tensor, "m 3"]
    phi_in: Float[Tensor, "m"]
    phi_out: Float[Tensor, "m"]
    beta: Float[Tensor, "m"]
    s_in: Float[Tensor, "m"]
    s_out: Float[Tensor, "m"]

    def take(self, i: Tensor) -> "_Wedge":
        rest = (getattr(self, n)[i] for n in list(_Wedge.__dataclass_fields__)[1:])
        return _Wedge(self.edges.take(i), *rest)

    def frame(self, away: Float[Tensor, "m 3"], u: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3 2"]:
        """Columns beta-hat and phi-hat of a ray that travels along u, ``away`` from the edge or to it."""
        # azimuth grows from face 0 towards its normal
        axis = torch.linalg.cross(along_face(self.normal0, self.normal1), self.normal0)
        phi = unit(torch.linalg.cross(axis, away))
        return torch.stack([torch.linalg.cross(u, phi), phi], -1)


def _wedge(at: Acting, i: Tensor, level: int, alone: Bool[Tensor, "m"]) -> _Wedge:
    assert at.edges is not None
    edges = at.edges.take(at.paths.item[i, level])
    point = at.paths.vertices[i, level + 1]
    t = edges.arc_length(point)
    _, tangent, _ = edges.point(t)
    normal0, normal1 = edges.normals(t)
    u_in, u_out = at.u[i, level], at.u[i, level + 1]
    length = segments(at.paths.vertices[i])[0]
    s_in = torch.where(alone, length[:, : level + 1].sum(1), length[:, level])
    s_out = torch.where(alone, length[:, level + 1 :].sum(1), length[:, level + 1])
    across = [u - (u * tangent).sum(-1, keepdim=True) * tangent for u in (-u_in, u_out)]
    sine = 0.5 * (across[0].norm(dim=-1) + across[1].norm(dim=-1))
    cosine = 0.5 * ((u_in + u_out) * tangent).sum(-1)
    phi_in, phi_out = (edges.angle(t, a) for a in across)
    beta = torch.atan2(sine, cosine)
    return _Wedge(
        edges, point, tangent, normal0, normal1, u_in, u_out, phi_in, phi_out, beta, s_in, s_out
    )  # fmt: skip


Weights = tuple[Tensor, Tensor, Tensor]  # R of face 0, R of face n, T: each [m f 2 2]


def _weights(at: Acting, which: Tensor, w: _Wedge, polarised: bool) -> Weights:
    """What both faces reflect, and what the direct ray keeps through the wedge, in the edge's frame;
    not polarised, each is the link's scalar coefficient times the unit matrix."""
    ahead = unit(w.u_in + w.u_out)
    reflected = []
    for normal in (w.normal0, w.normal1):
        c_in, c_out = (w.u_in * normal).sum(-1).abs(), (w.u_out * normal).sum(-1).abs()
        cosine = utd.mean_cosine(c_in, c_out, w.s_in, w.s_out).clamp(max=1.0)[:, None]
        slide = unit(ahead - (ahead * normal).sum(-1, keepdim=True) * normal)
        slide = torch.sqrt((1.0 - cosine**2).clamp(min=1e-24)) * slide
        contact = Contact(w.point, slide - cosine * normal, slide + cosine * normal, normal)
        pair = at.world.reflection(which, contact, at.frequency)
        reflected.append(
            _turned(torch.stack([pair[..., 0], -pair[..., 1]], -1), _face_turn(w, normal), False)
            if polarised
            else _both(pair)
        )
    enters0 = ((ahead * w.normal0).sum(-1) < (ahead * w.normal1).sum(-1))[:, None]
    enter, leave = (
        torch.where(enters0, w.normal0, w.normal1),
        torch.where(enters0, w.normal1, w.normal0),
    )
    step = 1e-6 * torch.minimum(w.s_in, w.s_out)[:, None] * ahead
    corner = Crossing(w.point - step, w.point + step, enter, leave)
    pair = at.world.transmission(which, corner, at.frequency)
    turn = _angle_between(w.frame(ahead, ahead), ahead, crossing_normal(ahead, enter, leave))
    return reflected[0], reflected[1], _turned(pair, turn, True) if polarised else _both(pair)


def _both(pair: Complex[Tensor, "m f 2"]) -> Complex[Tensor, "m f 2 2"]:
    return torch.diag_embed(scalar(pair)[..., None].expand(*pair.shape))


def _face_turn(w: _Wedge, normal: Tensor) -> Float[Tensor, "m"]:
    """Angle from the edge's frame to a face's plane of incidence, the two rays' mean.

    The outgoing ray's is counted the other way about: on the boundary it is the incoming one's image.
    """
    turn_in = _angle_between(w.frame(-w.u_in, w.u_in), w.u_in, normal)
    turn_out = -_angle_between(w.frame(w.u_out, w.u_out), w.u_out, normal)
    # angles of planes: a difference of pi is none
    gap = turn_out - turn_in
    gap = gap - math.pi * torch.round(gap / math.pi).detach()
    share = w.s_in / (w.s_in + w.s_out)  # weighted like the cosines, by its own distance
    return turn_in + (1.0 - share) * gap


def _angle_between(
    frame: Float[Tensor, "m 3 2"], u: Float[Tensor, "m 3"], normal: Float[Tensor, "m 3"]
) -> Float[Tensor, "m"]:
    """Angle from (beta, phi) to (TE, TM) of a plane of incidence; 0 where that has no direction."""
    te = torch.linalg.cross(u, normal)
    soft, hard = (te * frame[..., 0]).sum(-1), (te * frame[..., 1]).sum(-1)
    none = soft**2 + hard**2 < 1e-20
    return torch.atan2(
        torch.where(none, torch.zeros_like(hard), hard), torch.where(none, 1.0, soft)
    )


def _turned(
    pair: Complex[Tensor, "m f 2"], turn: Float[Tensor, "m"], through: bool
) -> Complex[Tensor, "m f 2 2"]:
    """diag(pair) of a plane of incidence in the edge's frame; a reflection turns back the other way."""
    cosine, sine = torch.cos(turn), torch.sin(turn)
    into = torch.stack([cosine, sine, -sine, cosine], -1).reshape(-1, 1, 2, 2).to(pair.dtype)
    out = into.mT if through else into
    return out @ torch.diag_embed(pair) @ into


def _summed(terms: Complex[Tensor, "m f 4"], weights: Weights) -> Complex[Tensor, "m f 2 2"]:
    reflection0, reflection1, kept = weights
    eye = torch.eye(2, dtype=terms.dtype, device=terms.device)
    direct = (terms[..., 0] + terms[..., 1])[..., None, None]
    return (
        direct * (eye - kept)
        + terms[..., 2, None, None] * reflection0
        + terms[..., 3, None, None] * reflection1
    )


def _arguments(at: Acting, w: _Wedge, back: bool = False) -> tuple[Tensor, ...]:
    """What utd's functions take, from the transmitter's side or from the receiver's."""
    k = 2.0 * math.pi * at.frequency[None] / SPEED_OF_LIGHT
    phi, s = (w.phi_in, w.phi_out), (w.s_in, w.s_out)
    if back:
        phi, s = phi[::-1], s[::-1]
    return (*(x[:, None] for x in (*phi, w.beta, w.edges.opening, *s)), k)


def _acts(
    at: Acting, i: Tensor, level: int, polarised: bool
) -> tuple[_Wedge, Complex[Tensor, "m f 2 2"], Float[Tensor, "m f"]]:
    """W [sqrt(m)] of edges at a level, and how clear they are of shadow boundaries. Of two edges of one
    object, the second answers for both."""
    before, after = _diffracts(at, i, level - 1), _diffracts(at, i, level + 1)
    w = _wedge(at, i, level, ~(before | after))
    which = at.paths.which[i, level]
    weights = _weights(at, which, w, polarised)
    own, clear = _summed(utd.wedge_terms(*_arguments(at, w)), weights), _clear(at, w)
    if level + 1 < at.paths.which.shape[1]:
        first = after & (at.paths.which[i, level + 1] == which)
        eye = torch.eye(2, dtype=own.dtype, device=own.device)
        own = torch.where(first[:, None, None, None], eye, own)
    j = torch.nonzero(before & (at.paths.which[i, max(level - 1, 0)] == which)).squeeze(-1)
    if len(j):
        those = (weights[0][j], weights[1][j], weights[2][j])
        pair, clear_first = _pair(at, i[j], level, w.take(j), own[j], those, polarised)
        own = own.index_copy(0, j, pair)
        clear = clear.index_copy(0, j, clear[j] * clear_first)
    return w, own, clear


def _clear(at: Acting, w: _Wedge) -> Float[Tensor, "m f"]:
    return utd.clearance(*_arguments(at, w))


def _diffracts(at: Acting, i: Tensor, level: int) -> Bool[Tensor, "m"]:
    if not 0 <= level < at.paths.which.shape[1]:
        return torch.zeros_like(i, dtype=torch.bool)
    return (at.paths.which[i, level] >= 0) & (at.paths.act[i, level] == int(Act.DIFFRACT))


def _pair(
    at: Acting,
    i: Tensor,
    level: int,
    second: _Wedge,
    w2: Tensor,
    weights2: Weights,
    polarised: bool,
) -> tuple[Complex[Tensor, "m f 2 2"], Float[Tensor, "m f"]]:
    """Two edges of one face: W_2 W_1 / 2 and the slopes' share; the equation stands in ``utd``."""
    first = _wedge(at, i, level - 1, torch.zeros_like(i, dtype=torch.bool))
    weights1 = _weights(at, at.paths.which[i, level - 1], first, polarised)
    w1 = _summed(utd.wedge_terms(*_arguments(at, first)), weights1)
    # azimuths from the common face at both edges: from face 0, or to face n
    sign = _from_face(first, first.phi_out) * _from_face(second, second.phi_in)
    slope1 = _summed(utd.slope_terms(*_arguments(at, first, back=True)), weights1)
    slope2 = _summed(utd.slope_terms(*_arguments(at, second)), weights2)
    # from the first edge's frame to the second's: the ray is one and the face is one, so but for signs
    between = -second.frame(-second.u_in, second.u_in).mT @ first.frame(first.u_out, first.u_out)
    between = between[:, None].to(w1.dtype)
    w1, slope1 = (between @ x @ between.mT for x in (w1, slope1))
    k = 2.0 * math.pi * at.frequency[None] / SPEED_OF_LIGHT
    reach = (first.s_out * torch.sin(first.beta) * torch.sin(second.beta))[:, None] * k
    slopes = -1j * (sign[:, None] / reach)[..., None, None] * (slope2 @ slope1)
    return 0.5 * (w2 @ w1 + slopes), _clear(at, first)


def _from_face(w: _Wedge, phi: Tensor) -> Tensor:
    """+1 where a grazing azimuth lies at face 0, -1 at face n."""
    near0 = phi < 0.5 * math.pi * w.edges.opening
    return torch.where(near0, torch.ones_like(phi), -torch.ones_like(phi))


def coefficient(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f"]:
    """Of an unpolarised link: near a shadow boundary the scalar wave's, elsewhere the mean power's.

    A diffracted scalar wave must take away exactly the step that direct or reflected scalar waves
    leave behind, and only the link's own scalar coefficients do that. On metal that is the soft wave,
    which dies along faces: deep in a shadow it is the hard one that a link lives by. There, as for
    mirrors, the mean power of the two polarisations counts. ``utd.clearance`` goes from one to the
    other without step or kink.
    """
    _, plain, clear = _acts(at, i, level, False)
    _, full, _ = _acts(at, i, level, True)
    mean = 0.5 * (full[..., 0, 0] + full[..., 1, 1])
    size = torch.sqrt(mean.real**2 + mean.imag**2 + TINY)
    power = torch.sqrt(0.5 * (full.real**2 + full.imag**2).sum((-1, -2)) + TINY)
    return torch.lerp(plain[..., 0, 0], power / size * mean, clear.to(plain.dtype))


TINY = 1e-60  # -600 dB: keeps roots of nothing differentiable


def dyad(at: Acting, i: Int[Tensor, "m"], level: int) -> Complex[Tensor, "m f 3 3"]:
    """What edges do to world field vectors: -B_out W B_in^T."""
    w, own, _ = _acts(at, i, level, True)
    b_in, b_out = w.frame(-w.u_in, w.u_in), w.frame(w.u_out, w.u_out)
    b_in, b_out = b_in[:, None].to(own.dtype), b_out[:, None].to(own.dtype)
    return -(b_out @ own @ b_in.mT)
