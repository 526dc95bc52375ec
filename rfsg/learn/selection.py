"""What may be learned: parameters of a scene by path pattern, on a private copy.

Everything that can be learned has a name. Patterns are matched against names (``*`` and ``?`` as in
a shell); a pattern without a part means shape and surface of the objects, or the gain of radios.

| name | |
|---|---|
| ``PRIM.shape.weights`` | of a neural shape |
| ``PRIM.surface.weights`` | hidden layers of a stochastic surface |
| ``PRIM.surface.m``, ``.alpha``, ``.phi``, ``.bulk`` | their heads, one field each |
| ``PRIM.surface.s``, ``.interaction_length`` | scalars of a stochastic surface, kept as logarithms |
| ``PRIM.surface.eps_r``, ``.sigma`` | constants of a known material |
| ``PRIM.pose.translation``, ``.rotation`` | a shift [m], and a turn about the object's origin [rad] |
| ``RADIO.gain_db`` | an offset of everything that a radio sends or hears |
| ``power.offset_db`` | an offset of every received power |

Objects that share an asset or a material share its parameters: to learn one is to learn all.
"""

import copy
import difflib
import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from rfsg.learn.errors import LearnError, SelectionError
from rfsg.learn.leaves import POWER, RATES, Leaf, leaves_of, offsets, rotation
from rfsg.objects.body import Body
from rfsg.objects.physics.media import VACUUM_PERMITTIVITY
from rfsg.objects.surfaces.interface import Dielectric
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene


@dataclass(frozen=True)
class Selection:
    """A private copy of a scene and what may change in it.

    base: bodies copied, none requires gradients but what is selected. moves: node number ->
    (translation [m], turn [rad]). gains: radio path -> offset [dB]. power: offset [dB], or None.
    """

    base: Scene
    leaves: tuple[Leaf, ...]
    matched: tuple[str, ...]
    moves: dict[int, tuple[nn.Parameter, nn.Parameter]] = field(default_factory=dict)
    gains: dict[str, nn.Parameter] = field(default_factory=dict)
    power: nn.Parameter | None = None

    def scene(self) -> Scene:
        """The scene as it is now; poses that are learned carry gradients."""
        if not self.moves:
            return self.base
        nodes = list(self.base.nodes)
        for i, (shift, turn) in self.moves.items():
            old = nodes[i].pose
            pose = Pose(rotation(turn) @ old.rotation, old.translation + shift, old.scale)
            nodes[i] = replace(nodes[i], pose=pose)
        return replace(self.base, nodes=tuple(nodes))

    def parameters(self) -> list[nn.Parameter]:
        """Every tensor that is learned, once."""
        return list({id(t): t for leaf in self.leaves for t in leaf.tensors}.values())

    def masks(self) -> list[Tensor | None]:
        """For each of ``parameters``: 1 where it may change, None for all of it."""
        masks: list[Tensor | None] = []
        for p in self.parameters():
            mine = [leaf for leaf in self.leaves if any(t is p for t in leaf.tensors)]
            if any(leaf.rows is None for leaf in mine):
                masks.append(None)
                continue
            mask = torch.zeros_like(p)
            for leaf in mine:
                mask[leaf.rows] = 1.0
            masks.append(mask)
        return masks

    def rates(self, other: Mapping[str, float] | None = None) -> list[float]:
        """For each of ``parameters``: its step against that of a weight.

        other: by pattern over names, instead of RATES. Raises LearnError for one that fits nothing.
        """
        rate = {id(t): RATES[leaf.kind] for leaf in self.leaves for t in leaf.tensors}
        for pattern, own in (other or {}).items():
            found = [f for f in self.leaves if fnmatch.filter(f.names, pattern)]
            if not found or not 0 <= own < float("inf"):
                names = ", ".join(leaf.names[0] for leaf in self.leaves)
                raise LearnError(
                    f"rates: {pattern!r}: {own!r}: expected a pattern over what is learned ({names}) "
                    "and a finite number >= 0"
                )
            rate |= {id(t): own for leaf in found for t in leaf.tensors}
        return [rate[id(p)] for p in self.parameters()]

    def nodes(self, *parts: str) -> list[int]:
        """Numbers of the nodes of which one of these parts is learned."""
        owners = {
            n.split(".", 1)[0] for leaf in self.leaves for n in leaf.names if _part(n) in parts
        }
        return [i for i, node in enumerate(self.base.nodes) if node.path in owners]

    def clamp(self) -> None:
        """Put constants that a step took over the edge of what is passive back on it."""
        with torch.no_grad():
            for leaf in self.leaves:
                least = {"eps_r": 1.0, "sigma": 0.0}.get(leaf.kind)
                if least is not None:
                    leaf.tensors[0].clamp_(min=least)

    def rows(self) -> list[dict[str, object]]:
        """One record per leaf: what, of whom, how many numbers, and who shares it unasked."""
        return [
            {
                "parameter": ".".join(leaf.names[0].split(".")[1:]),
                "objects": [o for o, n in zip(leaf.owners, leaf.names, strict=True) if n in asked],
                "count": leaf.count,
                "also": [o for o, n in zip(leaf.owners, leaf.names, strict=True) if n not in asked],
                "note": leaf.note,
            }
            for asked in [set(self.matched)]
            for leaf in self.leaves
        ]

    def table(self) -> str:
        """The same as text, for a person to read before anything is learned."""
        lines = [("parameter", "of", "numbers", "taught with it")]
        for row in self.rows():
            also = ", ".join(row["also"]) or "-"  # type: ignore[arg-type]
            note = f" ({row['note']})" if row["note"] else ""
            of = ", ".join(row["objects"]) or "-"  # type: ignore[arg-type]
            lines.append((f"{row['parameter']}{note}", of, str(row["count"]), also))
        widths = [max(len(line[i]) for line in lines) for i in range(4)]
        return "\n".join(
            "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )


def select(
    scene: Scene,
    patterns: Sequence[str],
    *,
    radios: Sequence[str] = (),
    frequency: float | None = None,
) -> Selection:
    """Choose what may be learned in a copy of ``scene``; the scene itself is never changed.

    radios: paths whose gains may be learned; by default those of the scene. frequency [Hz]: where an
    ITU material is chosen, the constants to start from are those at this frequency.
    Raises SelectionError for a pattern that matches nothing, with names that are near.
    """
    if isinstance(patterns, str):
        patterns = [patterns]
    paths = radios or [r.path for r in (*scene.transmitters, *scene.receivers)]
    base = _copied(scene)
    wanted = [_expanded(p, {n.path for n in base.nodes}, set(paths)) for p in patterns]
    if frequency is not None:
        for name in _itu_names(base):
            if any(fnmatch.fnmatchcase(name, form) for forms in wanted for form in forms):
                _thaw(base.node(name.split(".", 1)[0]).body, frequency)
    moves = {
        i: (_zeros(3), _zeros(3)) for i in range(len(base.nodes))
    }  # tensors for all: which ones are chosen shows below
    gains = {path: _zeros() for path in dict.fromkeys(paths)}
    power = _zeros()
    every = [*leaves_of(base, moves), *offsets(gains, power)]
    names = [name for leaf in every for name in leaf.names]
    matched: set[str] = set()
    faults = []
    for pattern, forms in zip(patterns, wanted, strict=True):
        found = {n for n in names for form in forms if fnmatch.fnmatchcase(n, form)}
        matched |= found
        if not found:
            faults.append(_nothing(pattern, base, names))
    if faults or not matched:
        raise SelectionError("\n".join(faults) or "select: empty; name what may be learned")
    leaves = tuple(leaf for leaf in every if matched & set(leaf.names))
    chosen = {id(t) for leaf in leaves for t in leaf.tensors}
    for leaf in leaves:
        for tensor in leaf.tensors:
            tensor.requires_grad_(True)
    return Selection(
        base,
        leaves,
        tuple(n for n in names if n in matched),
        {i: pair for i, pair in moves.items() if any(id(t) in chosen for t in pair)},
        {path: p for path, p in gains.items() if id(p) in chosen},
        power if id(power) in chosen else None,
    )


def _itu_names(scene: Scene) -> list[str]:
    media = [(n, getattr(n.body.surface, "medium", None)) for n in scene.nodes]
    return [
        f"{node.path}.surface.{constant}"
        for node, medium in media
        if isinstance(medium, Dielectric) and medium.itu is not None
        for constant in ("eps_r", "sigma")
    ]


def _thaw(body: Body, frequency: float) -> None:
    """An ITU material becomes constants, those that it has at a frequency."""
    medium = getattr(body.surface, "medium", None)
    if not isinstance(medium, Dielectric) or medium.itu is None:
        return  # already done: materials are shared
    at = torch.tensor([frequency], dtype=torch.float64)
    eps = medium.permittivity(at)
    sigma = -eps.imag * 2.0 * torch.pi * frequency * VACUUM_PERMITTIVITY
    began = f"from ITU {medium.itu} at {frequency / 1e9:g} GHz"
    constants = Dielectric(eps_r=float(eps.real), sigma=float(sigma))
    medium.eps_r, medium.sigma = constants.eps_r, constants.sigma
    medium.itu, medium.began_as = None, began  # type: ignore[assignment]


# patterns


def _part(name: str) -> str:
    return name.split(".")[1]


def _expanded(pattern: str, objects: set[str], radios: set[str]) -> list[str]:
    """The full forms of a pattern: a part, and what is in it, where these are left out."""
    head, *rest = pattern.split(".")
    if not rest and head == "power":
        return [POWER]
    if not rest:
        return [f"{head}.shape.*", f"{head}.surface.*", f"{head}.gain_db"]
    return [pattern, f"{pattern}.*"] if len(rest) == 1 else [pattern]


def _nothing(pattern: str, scene: Scene, names: list[str]) -> str:
    """Why a pattern matches nothing, and what is near."""
    head = pattern.split(".", 1)[0]
    said = f"select: {pattern!r} matches nothing that can be learned"
    nodes = [n for n in scene.nodes if fnmatch.fnmatchcase(n.path, head)]
    if nodes:
        own = [name for node in nodes for name in names if name.startswith(f"{node.path}.")]
        return f"{said}; {_made_of(nodes[0])}; it has {', '.join(own[:12])}"
    known = [*{name.split(".", 1)[0]: None for name in names}]
    near = difflib.get_close_matches(head.replace("*", ""), known, 5, 0.4)
    return f"{said}: no object or radio at {head!r}; near it: {', '.join(near or known[:12])}"


def _made_of(node: Node) -> str:
    shape, surface = node.body.shape.kind, node.body.surface.kind
    said = f"{node.path} is a {shape} with a {surface} surface"
    if surface in ("conductor",):
        said += " (a conductor has no constants: give it a StochasticSurface to learn one)"
    medium = getattr(node.body.surface, "medium", None)
    if isinstance(medium, Dielectric) and medium.itu is not None:
        said += f" (ITU {medium.itu}: give a frequency, so that its constants are known)"
    return said


# the private copy


def _copied(scene: Scene) -> Scene:
    """The scene with bodies of its own, frozen; what they share they go on sharing."""
    bodies = copy.deepcopy([node.body for node in scene.nodes])
    for body in bodies:
        body.requires_grad_(False)
    nodes = [
        replace(node, body=body, pose=_still(node.pose))
        for node, body in zip(scene.nodes, bodies, strict=True)
    ]
    return replace(scene, nodes=tuple(nodes))


def _still(pose: Pose) -> Pose:
    return Pose(pose.rotation.detach(), pose.translation.detach(), pose.scale.detach())


def _zeros(*size: int) -> nn.Parameter:
    return nn.Parameter(torch.zeros(size, dtype=torch.float64), requires_grad=False)
