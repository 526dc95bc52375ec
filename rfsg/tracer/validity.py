"""Where the model ends: what is refused before anything is traced, and what is said with the answer.

Rays are the limit of short waves: objects large against the wavelength, radios out of each other's
near fields, materials within the band that they were measured in. Beyond, the tracer still gives a
number, and says here why it should not be believed.
"""

import math
from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.physics import media
from rfsg.objects.physics.fresnel import SPEED_OF_LIGHT
from rfsg.objects.shapes.edges import BLUNT_DEG
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.shapes.presence import absence
from rfsg.objects.surfaces.interface import Dielectric
from rfsg.scene.errors import SceneError
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node
from rfsg.scene.world import World

SHOWN = 5  # names in a sentence before "and more"
PAIRS = 1 << 20  # of radios and objects looked at together: bounds memory


def refuse(world: World, frequency: Float[Tensor, "f"]) -> None:
    """Raises SceneError, one fault for each object, for what would end in a number without meaning:
    poses that are none, parameters that are not finite, learned shapes without a surface, and ITU
    materials asked for outside their bands without ``extrapolate``."""
    faults = _poses(world)
    # a shape whose weights are broken is not asked where its surface is
    for question in (_parameters, _presence, lambda body: _band(body, frequency)):
        faults = faults or _asked(world.scene.nodes, question)
    if faults:
        raise SceneError(faults)


def sentences(world: World, frequency: Float[Tensor, "f"]) -> tuple[str, ...]:
    """What to keep in mind with the results of this scene at these frequencies [Hz], if anything:
    objects below a wavelength, radios in near fields, materials beyond their band."""
    wavelength = SPEED_OF_LIGHT / float(frequency.min())
    said = (
        _small(world, wavelength),
        _round_meshes(world),
        _close_radios(world, wavelength),
        *_surfaces_near_radios(world, wavelength),
        *_extrapolated(world, frequency),
        *_beyond_learned(world, frequency),
    )
    return tuple(s for s in said if s)


# refused


def _poses(world: World) -> list[str]:
    """Poses that are not finite, scaled by nothing, or neither turned nor mirrored rigidly."""
    eye = torch.eye(3, dtype=torch.float64, device=world.device)
    skew = (world.rotation @ world.rotation.mT - eye).abs().amax((1, 2)) if len(world) else eye[:0]
    checks = (
        (~torch.isfinite(world.translation).all(-1), "translation is not finite"),
        (~torch.isfinite(world.velocity).all(-1), "velocity is not finite"),
        (~(world.scale > 0) | ~torch.isfinite(world.scale), "scale is not a finite number > 0"),
        (~(skew < RIGID), "rotation is not orthonormal (a rotation or a mirror)"),
    )
    return [
        f"{world.scene.nodes[i].path}: pose: {fault}"
        for bad, fault in checks
        for i in torch.nonzero(bad).flatten().tolist()
    ]


RIGID = 1e-6  # what |R R^T - 1| may be: float32 matrices from elsewhere pass


def _asked(nodes: Iterable[Node], question: Callable[[Body], str | None]) -> list[str]:
    """Faults of nodes; bodies that many nodes share are asked once."""
    answers: dict[int, str | None] = {}
    for node in nodes:
        if id(node.body) not in answers:
            answers[id(node.body)] = question(node.body)
    return [f"{node.path}: {why}" for node in nodes if (why := answers[id(node.body)])]


def _parameters(body: Body) -> str | None:
    for name, value in (*body.named_parameters(), *body.named_buffers()):
        if name not in UNBOUNDED and not bool(torch.isfinite(value).all()):
            return f"{name} holds a number that is not finite"
    for name, value in body.named_parameters():
        if name in LENGTHS and not bool((value > 0).all()):
            return f"{name} is {value.tolist()}; expected lengths > 0 [m]"
    return None


UNBOUNDED = ("shape._bounds",)  # a half-space reaches to infinity
LENGTHS = ("shape.half_size", "shape.radius", "shape.half_height")


def _presence(body: Body) -> str | None:
    shape = body.shape
    if shape.exact:
        return None
    why = absence(shape)
    return f"the {shape.kind} shape {why}" if why else None


def _band(body: Body, frequency: Tensor) -> str | None:
    medium = _medium(body)
    if medium is None or medium.itu is None or medium.extrapolate:
        return None
    try:
        medium.permittivity(frequency.detach())
    except ValueError as error:
        return f"{error} (in a scene: rfsg:material:extrapolate = true)"
    return None


def _medium(body: Body) -> Dielectric | None:
    return getattr(body.surface, "medium", None)


# said


def _small(world: World, wavelength: float) -> str:
    """Objects narrower than a wavelength: across the second longest side of their bounds, for a wall
    may well be thin, but a mirror must be wide both ways."""
    extent = (world.bounds_object[:, 1] - world.bounds_object[:, 0]).detach()
    width = extent.sort(dim=-1).values[:, 1] * world.scale.detach()
    return _about(
        world,
        torch.nonzero(width < wavelength).squeeze(-1),
        f"narrower than a wavelength ({wavelength:.3g} m): rays do not describe how waves scatter "
        "from them; trust neither their reflections nor their shadows",
    )


def _round_meshes(world: World) -> str:
    """Meshes whose faces mostly turn a little from one to the next."""
    shapes = {id(n.body.shape): n.body.shape for n in world.scene.nodes}
    found = {key for key, s in shapes.items() if isinstance(s, Mesh) and is_round(s)}
    return _sentence(
        [n.path for n in world.scene.nodes if id(n.body.shape) in found],
        "a mesh that stands for a round surface: each facet is a flat mirror, too strong "
        "where it reflects, and nothing between; draw it as a round shape, or learn it "
        "(`rfsg learn-shape`)",
    )


@torch.no_grad()
def is_round(mesh: Mesh) -> bool:
    """Whether most of the edges between faces, by length, are too blunt to be the thing's own."""
    pair = mesh.face[mesh.sides]
    normal = mesh.planes()[pair, :3]
    blunt = (normal[:, 0] * normal[:, 1]).sum(-1) > math.cos(math.radians(BLUNT_DEG))
    length = (mesh.vertices[mesh.ends[:, 0]] - mesh.vertices[mesh.ends[:, 1]]).norm(dim=-1)
    length = torch.where(pair[:, 0] != pair[:, 1], length, 0.0)
    return float(length[blunt].sum()) > 0.5 * float(length.sum())


def _close_radios(world: World, wavelength: float) -> str:
    scene = world.scene
    tx, rx = (_positions(r, world) for r in (scene.transmitters, scene.receivers))
    near = torch.nonzero(torch.cdist(tx, rx) < _near_field(wavelength)).tolist()
    names = [f"{scene.transmitters[t].path} and {scene.receivers[r].path}" for t, r in near]
    return _sentence(
        names,
        f"closer than lambda / 2 pi ({_near_field(wavelength):.3g} m): antennas in each other's near "
        "field couple in ways that no path gain describes; it may exceed 1",
    )


def _surfaces_near_radios(world: World, wavelength: float) -> list[str]:
    """Radios that stand in an object, or within the reactive near field of its surface."""
    radios = (*world.scene.transmitters, *world.scene.receivers)
    at = _positions(radios, world)
    reach = _near_field(wavelength)
    within, beside = [], []
    block = max(1, PAIRS // max(1, len(world)))
    for first in range(0, len(at), block):
        for r, which, inside in _beside(world, at[first : first + block], reach):
            pair = f"{radios[first + r].path} at {world.scene.nodes[which].path}"
            (within if inside else beside).append(pair)
    return [
        _sentence(
            within,
            "inside the object: a known material is crossed whole from there, a conductor or "
            "half-space lets nothing out, and what the object does to the antenna is not modelled",
        ),
        _sentence(
            beside,
            f"closer to a surface than lambda / 2 pi ({reach:.3g} m): the surface is in the antenna's "
            "near field and acts on the antenna itself, not only on what it sends",
        ),
    ]


def _near_field(wavelength: float) -> float:
    """Where the reactive field of a small antenna ends [m] (Balanis, Antenna Theory, section 4.2)."""
    return wavelength / (2.0 * torch.pi)


@torch.no_grad()
def _beside(world: World, at: Float[Tensor, "r 3"], reach: float) -> list[tuple[int, int, bool]]:
    """(radio, node, inside?) where a radio is in an object or its surface within ``reach`` [m]."""
    r, n = len(at), len(world)
    row = torch.arange(r, device=world.device).repeat_interleave(n)
    which = torch.arange(n, device=world.device).repeat(r)
    local = world.point_object(which, at[row])
    low, high = world.bounds_object[which].detach().unbind(1)
    nearest = torch.minimum(torch.maximum(local, low), high)
    beyond = (local - nearest).norm(dim=-1) * world.scale[which]
    i = torch.nonzero(beyond < reach).squeeze(-1)
    # outside its bounds a shape need not know its distance: that at the bounds is close enough
    value = world.sdf(which[i], world.point_world(which[i], nearest[i]))
    inside = (value < -ON_IT) & (beyond[i] == 0)
    close = inside | (value.abs() + beyond[i] < reach)
    return list(
        zip(row[i][close].tolist(), which[i][close].tolist(), inside[close].tolist(), strict=True)
    )


ON_IT = 1e-8  # [m] this deep is still on the surface


def _positions(radios: tuple[Radio, ...], world: World) -> Float[Tensor, "n 3"]:
    if not radios:
        return torch.zeros(0, 3, dtype=torch.float64, device=world.device)
    return torch.stack([r.position.detach().to(world.translation) for r in radios])


def _extrapolated(world: World, frequency: Tensor) -> list[str]:
    """One sentence for each ITU material whose formula is used beyond its bands."""
    users: dict[str, list[str]] = {}
    for node in world.scene.nodes:
        medium = _medium(node.body)
        if medium is not None and medium.itu is not None and medium.extrapolate:
            users.setdefault(medium.itu, []).append(node.path)
    found = []
    for name, paths in users.items():
        beyond = media.outside(name, frequency)
        if beyond:
            at = ", ".join(f"{hz / 1e9:g}" for hz in beyond[:SHOWN])
            what = f"{name} at {at} GHz is an extrapolation: {media.bands(name)}"
            found.append(_sentence(paths, what))
    return found


def _beyond_learned(world: World, frequency: Tensor) -> list[str]:
    """One sentence for each band that objects were learned at and that a frequency lies beyond."""
    users: dict[tuple[float, float], list[str]] = {}
    for node in world.scene.nodes:
        if node.body.band is not None:
            users.setdefault(node.body.band, []).append(node.path)
    lowest, highest = float(frequency.min()), float(frequency.max())
    found = []
    for (low, high), paths in users.items():
        off = []
        if lowest < low:
            off.append(f"{lowest / 1e9:g} GHz lies {_apart(low - lowest, low)} below")
        if highest > high:
            off.append(f"{highest / 1e9:g} GHz lies {_apart(highest - high, high)} above")
        if off:
            band = f"{low / 1e9:g} GHz" if low == high else f"{low / 1e9:g} to {high / 1e9:g} GHz"
            what = f"learned at {band}: {' and '.join(off)}, where what they answer is an extrapolation"
            found.append(_sentence(paths, what))
    return found


def _apart(difference: float, of: float) -> str:
    return f"{difference / 1e9:.3g} GHz ({100.0 * difference / of:.3g} %)"


def _about(world: World, which: Int[Tensor, "m"], what: str) -> str:
    return _sentence([world.scene.nodes[i].path for i in which.tolist()], what)


def _sentence(names: list[str], what: str) -> str:
    if not names:
        return ""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{', '.join(names[:SHOWN])}{more}: {what}"
