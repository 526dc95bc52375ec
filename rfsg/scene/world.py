"""The scene asks its objects' questions, by index, in the world frame.

World-to-object happens here and nowhere else, and so does grouping a batch: points of all nodes
that share a shape or a surface go to it in one call. Frames are float64 always; a shape may be asked
in float32.
"""

import json
import math
from collections.abc import Callable, Iterator
from copy import copy
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing, Jet, Shape
from rfsg.objects.shapes.analytic import Box, Boxes, HalfSpace
from rfsg.objects.shapes.sheet import Sheet
from rfsg.objects.shapes.sheets import Sheets, Table
from rfsg.objects.shapes.sketch import Sketched, sketch_of
from rfsg.objects.surfaces.interface import Known
from rfsg.objects.surfaces.solid import PARALLEL, Backed, Solid, depth_behind, stretched
from rfsg.scene.scene import Scene


class World:
    """A scene laid out as tensors: poses stacked, bodies listed once. ``which`` indexes nodes.

    samples, integral: how crossings of learned surfaces are integrated; None leaves it to each.
    diffuse: whether learned surfaces part with their diffuse share; known ones always do.
    """

    def __init__(
        self,
        scene: Scene,
        device: torch.device | str = "cpu",
        *,
        samples: int | None = None,
        integral: str = "telescoped",
        diffuse: bool = False,
    ):
        self.scene = scene
        self.device = torch.device(device)
        nodes = scene.nodes
        self.rotation = _stack([n.pose.rotation for n in nodes], (3, 3), self.device)
        self.translation = _stack([n.pose.translation for n in nodes], (3,), self.device)
        self.scale = _stack([n.pose.scale for n in nodes], (), self.device)
        self.velocity = _stack([n.velocity for n in nodes], (3,), self.device)
        for body in {id(n.body): n.body for n in nodes}.values():
            if not _is_on(body, self.device):
                body.to(self.device)
        self.shapes, self.shape_of_node = _distinct(
            [_shape_key(n.body) for n in nodes], self.device
        )
        keys: dict[int, object] = {}  # a city has few surfaces, on thousands of bodies
        bodies, self.surface_of_node = _distinct(
            [(_surface_key(n.body, keys), n.body) for n in nodes], self.device
        )
        self.surfaces = [_with_numerics(b, samples, integral, diffuse) for b in bodies]
        boxes = [n.body.shape for n in nodes if isinstance(n.body.shape, Box)]
        self.half_size = _stack([b.half_size for b in boxes], (3,), self.device)
        is_box = torch.tensor([isinstance(n.body.shape, Box) for n in nodes], device=self.device)
        self.box_of_node = torch.cumsum(is_box.long(), 0) - 1
        found = [(id(s), s) if pooled(s := n.body.shape) else (None, None) for n in nodes]
        sheets, self.sheet_of_node = _distinct([(None, None), *found], self.device)
        self.sheet_of_node = self.sheet_of_node[1:] - 1  # -1 of what is none
        self.sheets = Table(sheets[1:], self.device) if sheets[1:] else None
        if self.sheets:
            self.sheets.hand_out()
        self.bounds_object = _stack([n.body.shape.bounds() for n in nodes], (2, 3), self.device)
        self.exact = self._flags(lambda b: b.shape.exact)
        self.faceted = self._flags(lambda b: b.shape.faceted)
        self.flat = self._flags(lambda b: b.shape.faceted and b.shape.convex)
        self.rectangular = self._flags(lambda b: isinstance(b.shape, (Box, HalfSpace)))
        self.convex = self._flags(lambda b: b.shape.convex)
        self.opaque = self._flags(lambda b: b.surface.opaque)
        self.learned_surface = self._flags(lambda b: b.surface.kind == "stochastic")
        self.lipschitz = torch.tensor(
            [n.body.shape.lipschitz for n in nodes], dtype=torch.float64, device=self.device
        )
        extent = self.bounds_object[:, 1] - self.bounds_object[:, 0]
        size = torch.where(torch.isfinite(extent), extent, torch.zeros_like(extent)).amax(-1)
        self.size = torch.where(size > 0, size, torch.ones_like(size)) * self.scale.detach()
        self.solid = self._flags(lambda b: isinstance(b.surface, Solid))
        media, self.medium = _distinct([_medium_key(n.body) for n in nodes], self.device)
        self.media = [m.surface for m in media]

    def __len__(self) -> int:
        return len(self.scene.nodes)

    def sketched(self, error: float) -> "World":
        """The same scene for rough answers: networks whose sketches err by less than ``error`` [m] give
        f and its gradient by those (``objects.shapes.sketch``). Itself where there are none."""
        rough, changed = copy(self), False
        rough.shapes = list(self.shapes)
        for k, shape in enumerate(self.shapes):
            if shape is None:  # the boxes, the sheets
                continue
            found, scale = sketch_of(shape), float(self.scale[self.shape_of_node == k].max())
            if found is not None and found.error * scale < error:
                rough.shapes[k], changed = Sketched(shape, found), True
        return rough if changed else self

    def _flags(self, question: Callable[[Body], bool]) -> Bool[Tensor, "n"]:
        bodies = {id(n.body): n.body for n in self.scene.nodes}  # instances of one are asked once
        answers = {key: bool(question(body)) for key, body in bodies.items()}
        each = [answers[id(n.body)] for n in self.scene.nodes]
        return torch.tensor(each, dtype=torch.bool, device=self.device)

    def groups(self, which: Int[Tensor, "m"]) -> Iterator[tuple[Shape, Tensor]]:
        """(shape, positions in the batch) for every shape that the batch touches.

        All boxes of a scene come as one ``Boxes``, a row for each of their positions, and so do all sheets
        as one ``Sheets``, less those with so many positions that each is better asked alone.
        """
        owner = self.shape_of_node[which]
        for k in _present(owner):
            i, shape = torch.nonzero(owner == k).squeeze(-1), self.shapes[k]
            if shape is not None:
                yield shape, i
            elif int(self.sheet_of_node[which[i[0]]]) < 0:
                yield Boxes(self.half_size[self.box_of_node[which[i]]]), i
            else:
                yield from self._sheet_groups(which, i)

    def _sheet_groups(self, which: Tensor, i: Tensor) -> Iterator[tuple[Shape, Tensor]]:
        assert self.sheets is not None
        sheet = self.sheet_of_node[which[i]]
        rows = torch.bincount(sheet, minlength=len(self.sheets.sheets))
        crowded = rows * self.sheets.triangle.count > CROWDED
        few = ~crowded[sheet]
        if bool(few.any()):
            yield Sheets(self.sheets, sheet[few]), i[few]
        for k in torch.nonzero(crowded).squeeze(-1).tolist():
            yield self.sheets.sheets[k], i[sheet == k]

    def surface_groups(self, which: Int[Tensor, "m"]) -> Iterator[tuple[Body, Tensor]]:
        """(body, positions in the batch) for every surface; equal known materials are one."""
        owner = self.surface_of_node[which]
        for k in _present(owner):
            yield self.surfaces[k], torch.nonzero(owner == k).squeeze(-1)

    # frames

    def point_object(
        self, which: Int[Tensor, "m"], point_world: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        dtype = point_world.dtype
        moved = point_world - self.translation[which].to(dtype)
        turned = torch.einsum("mij,mi->mj", self.rotation[which].to(dtype), moved)
        return turned / self.scale[which, None].to(dtype)

    def direction_object(
        self, which: Int[Tensor, "m"], direction_world: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        rotation = self.rotation[which].to(direction_world.dtype)
        return torch.einsum("mij,mi->mj", rotation, direction_world)

    def point_world(
        self, which: Int[Tensor, "m"], point_object: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        dtype = point_object.dtype
        turned = torch.einsum("mij,mj->mi", self.rotation[which].to(dtype), point_object)
        return turned * self.scale[which, None].to(dtype) + self.translation[which].to(dtype)

    def direction_world(
        self, which: Int[Tensor, "m"], direction_object: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        rotation = self.rotation[which].to(direction_object.dtype)
        return torch.einsum("mij,mj->mi", rotation, direction_object)

    # shapes

    def value_and_gradient(
        self,
        which: Int[Tensor, "m"],
        point_world: Float[Tensor, "m 3"],
        dtype: torch.dtype = torch.float64,
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m 3"]]:
        """f [m] and its gradient in the world; shapes are asked in ``dtype``, frames stay float64."""
        p = self.point_object(which, point_world)
        value, gradient = p.new_zeros(p.shape[0]), torch.zeros_like(p)
        for shape, i in self.groups(which):
            v, g = shape.value_and_gradient(p[i].to(dtype))
            value = value.index_copy(0, i, v.to(p.dtype))
            gradient = gradient.index_copy(0, i, g.to(p.dtype))
        return value * self.scale[which], self.direction_world(which, gradient)

    def sdf(
        self,
        which: Int[Tensor, "m"],
        point_world: Float[Tensor, "m 3"],
        dtype: torch.dtype = torch.float64,
    ) -> Float[Tensor, "m"]:
        """f [m]; shapes are asked in ``dtype``, frames stay float64."""
        p = self.point_object(which, point_world)
        value = p.new_zeros(p.shape[0])
        for shape, i in self.groups(which):
            value = value.index_copy(0, i, shape.sdf(p[i].to(dtype)).to(p.dtype))
        return value * self.scale[which]

    def jet(
        self,
        which: Int[Tensor, "m"],
        point_world: Float[Tensor, "m 3"],
        dtype: torch.dtype = torch.float64,
    ) -> Jet:
        """f to second order in the world: [m], [1], [1/m]; shapes are asked in ``dtype``."""
        p = self.point_object(which, point_world)
        value, gradient = p.new_zeros(p.shape[0]), torch.zeros_like(p)
        hessian = p.new_zeros(p.shape[0], 3, 3)
        for shape, i in self.groups(which):
            j = shape.jet(p[i].to(dtype))
            value = value.index_copy(0, i, j.value.to(p.dtype))
            gradient = gradient.index_copy(0, i, j.gradient.to(p.dtype))
            hessian = hessian.index_copy(0, i, j.hessian.to(p.dtype))
        r, s = self.rotation[which].to(p.dtype), self.scale[which].to(p.dtype)
        hessian = r @ hessian @ r.transpose(-1, -2) / s[:, None, None]
        return Jet(value * s, self.direction_world(which, gradient), hessian)

    def normal(
        self, which: Int[Tensor, "m"], point_world: Float[Tensor, "m 3"]
    ) -> Float[Tensor, "m 3"]:
        """Outward unit normals at surface points; zero where the gradient vanishes."""
        p = self.point_object(which, point_world)
        normal = torch.zeros_like(p)
        for shape, i in self.groups(which):
            own = getattr(shape, "normal_at", None)
            n = own(p[i]) if own else unit(shape.value_and_gradient(p[i])[1])
            normal = normal.index_copy(0, i, n)
        return self.direction_world(which, normal)

    def patch(self, which: Int[Tensor, "m"], point_world: Float[Tensor, "m 3"]) -> Int[Tensor, "m"]:
        """Which smooth piece of its object's surface each point lies on."""
        p = self.point_object(which, point_world)
        patch = torch.zeros_like(which)
        for shape, i in self.groups(which):
            patch[i] = shape.patch(p[i]).to(patch.dtype)
        return patch

    def interval(
        self,
        which: Int[Tensor, "m"],
        origin: Float[Tensor, "m 3"],
        direction: Float[Tensor, "m 3"],
    ) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """Closed-form (enter, leave) [m] of whole lines through convex nodes; (inf, -inf) for a miss."""
        o, d = self.point_object(which, origin), self.direction_object(which, direction)
        enter, leave = o.new_zeros(o.shape[0]), o.new_zeros(o.shape[0])
        for shape, i in self.groups(which):
            a, b = shape.interval(o[i], d[i])
            enter, leave = enter.index_copy(0, i, a), leave.index_copy(0, i, b)
        scale = self.scale[which].to(o.dtype)
        return enter * scale, leave * scale

    def plane(
        self, which: Int[Tensor, "m"], patch: Int[Tensor, "m"]
    ) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"], Bool[Tensor, "m"]]:
        """Planar patches in the world: normal, offset d of n.x = d, and whether the patch is planar."""
        normal = torch.zeros(which.shape[0], 3, dtype=torch.float64, device=self.device)
        offset, planar = normal[:, 0].clone(), torch.zeros_like(which, dtype=torch.bool)
        for shape, i in self.groups(which):
            if isinstance(shape, (Boxes, Sheets)):
                j, rows = i, shape.plane_of(patch[i])
            else:
                table = shape.planes().to(torch.float64)
                j = i[patch[i] < table.shape[0]]
                rows = table[patch[j]]
            normal = normal.index_copy(0, j, rows[:, :3])
            offset = offset.index_copy(0, j, rows[:, 3])
            planar[j] = True
        normal = self.direction_world(which, normal)
        place = (normal * self.translation[which]).sum(-1)
        return normal, offset * self.scale[which] + place, planar

    @cached_property
    def planar_patches(self) -> Int[Tensor, "n"]:
        """How many planar patches each node has: they are numbered first."""
        count = {id(n.body.shape): len(n.body.shape.planes()) for n in self.scene.nodes}
        numbers = [count[id(n.body.shape)] for n in self.scene.nodes]
        return torch.tensor(numbers, dtype=torch.int64, device=self.device)

    def is_planar(self, which: Int[Tensor, "*b"], patch: Int[Tensor, "*b"]) -> Bool[Tensor, "*b"]:
        """Whether patches of nodes are planar."""
        return patch < self.planar_patches[which]

    # surfaces

    def reflection(
        self, which: Int[Tensor, "m"], contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "m f 2"]:
        """Reflection coefficients (TE, TM) at contacts given in the world."""
        out = _complex(which, frequency)
        for body, i, mine in self._contacts_object(which, contact):
            out = out.index_copy(0, i, body.reflection(mine, frequency).to(out.dtype))
        return out

    def diffuse(
        self, which: Int[Tensor, "m"], contact: Contact, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "m f 2"]:
        """Amplitudes (TE, TM) of what scatters at contacts given in the world; 0 where smooth."""
        out = _complex(which, frequency)
        for body, i, mine in self._contacts_object(which, contact):
            if body.scattering is not None:
                out = out.index_copy(0, i, body.diffuse(mine, frequency).to(out.dtype))
        return out

    def _contacts_object(
        self, which: Tensor, contact: Contact
    ) -> Iterator[tuple[Body, Tensor, Contact]]:
        """(body, positions in the batch, contacts in its frame) for every surface.

        Known materials answer to angles alone, and those are the same in every frame.
        """
        for body, i in self.surface_groups(which):
            alone = len(i) == len(which)  # then positions are in order
            mine = contact if alone else Contact(*(getattr(contact, n)[i] for n in _CONTACT))
            if isinstance(body.surface, Solid):
                behind = self.behind(which[i], mine.point, mine.normal)
                mine = Backed(mine.point, mine.incoming, mine.outgoing, mine.normal, behind)
            elif not isinstance(body.surface, Known):
                mine = self._contact_object(which[i], mine)
            yield body, i, mine

    def _contact_object(self, which: Int[Tensor, "m"], contact: Contact) -> Contact:
        return Contact(
            self.point_object(which, contact.point),
            self.direction_object(which, contact.incoming),
            self.direction_object(which, contact.outgoing),
            self.direction_object(which, contact.normal),
        )

    def transmission(
        self,
        which: Int[Tensor, "m"],
        crossing: Crossing,
        frequency: Float[Tensor, "f"],
        last: Int[Tensor, "m"] | None = None,
    ) -> Complex[Tensor, "m f 2"]:
        """Transmission (TE, TM) relative to free space, of crossings given in the world.

        last: the nodes on which the stretches end, where these are several solids of one medium.
        """
        out = _complex(which, frequency)
        for body, i, mine in self._crossings_object(which, crossing, last):
            out = out.index_copy(0, i, body.transmission(mine, frequency).to(out.dtype))
        return out

    def excess_delay(
        self,
        which: Int[Tensor, "m"],
        crossing: Crossing,
        frequency: Float[Tensor, "f"],
        last: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "m f"]:
        """Group delay beyond free space [s], of crossings given in the world; last as above."""
        out = torch.zeros(len(which), len(frequency), dtype=torch.float64, device=self.device)
        for body, i, mine in self._crossings_object(which, crossing, last):
            out = out.index_copy(0, i, body.excess_delay(mine, frequency).to(out.dtype))
        return out

    def _crossings_object(
        self, which: Tensor, crossing: Crossing, last: Tensor | None
    ) -> Iterator[tuple[Body, Tensor, Crossing]]:
        local = Crossing(
            self.point_object(which, crossing.start),
            self.point_object(which, crossing.end),
            self.direction_object(which, crossing.normal_start),
            self.direction_object(which, crossing.normal_end),
        )
        for body, i in self.surface_groups(which):
            mine = Crossing(
                local.start[i], local.end[i], local.normal_start[i], local.normal_end[i]
            )
            if isinstance(body.surface, Solid):
                end = which[i] if last is None else last[i]
                flat = self.is_flat(which[i], crossing.start[i])
                flat &= self.is_flat(end, crossing.end[i])
                exact = self.exact[which[i]] & self.exact[end]
                mine = stretched(mine, flat, exact, self.scale[which[i]])
            yield body, i, mine

    # solids

    def is_flat(
        self, which: Int[Tensor, "m"], point_world: Float[Tensor, "m 3"]
    ) -> Bool[Tensor, "m"]:
        """Whether surface points lie on a plane face."""
        flat = self.faceted[which]
        i = torch.nonzero(~flat).squeeze(-1)  # the others say where they are
        flat[i] = self.is_planar(which[i], self.patch(which[i], point_world[i]))
        return flat

    def index(self, which: Int[Tensor, "m"], frequency: Float[Tensor, "f"]) -> Float[Tensor, "m f"]:
        """Index of refraction Re sqrt(eps_c) of solids."""
        return self._of_media(which, lambda solid, i: solid.index(frequency).expand(len(i), -1))

    def face(
        self, which: Int[Tensor, "m"], cosine: Float[Tensor, "m"], frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "m f 2"]:
        """(TE, TM) amplitude of passing one face of solids, at the |cos| outside."""
        return self._of_media(which, lambda solid, i: solid.face(cosine[i], frequency))

    def inside(
        self, which: Int[Tensor, "m"], length: Float[Tensor, "m"], frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "m f"]:
        """What lengths [m] inside solids do to a wave, relative to free space."""
        return self._of_media(which, lambda solid, i: solid.inside(length[i], frequency))

    def inside_delay(
        self, which: Int[Tensor, "m"], length: Float[Tensor, "m"], frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "m f"]:
        """Group delay of lengths [m] inside solids, beyond free space [s]."""
        return self._of_media(which, lambda solid, i: solid.inside_delay(length[i], frequency))

    def _of_media(self, which: Tensor, ask: Callable[[Solid, Tensor], Tensor]) -> Tensor:
        """One answer for every solid in ``which``, asked of each medium once."""
        medium = self.medium[which]
        order = torch.argsort(medium, stable=True)
        parts = []
        for k in torch.unique(medium).tolist():
            parts.append(ask(self.media[k], torch.nonzero(medium == k).squeeze(-1)))
        return torch.cat(parts)[torch.argsort(order)]

    def behind(
        self,
        which: Int[Tensor, "m"],
        point_world: Float[Tensor, "m 3"],
        normal_world: Float[Tensor, "m 3"],
    ) -> Float[Tensor, "m"]:
        """How far solids reach behind plane faces, to a face parallel to them [m]; inf without one.

        A solid of the same medium that is flush with the face behind is more of the same. 0 where
        the face itself lies in or against one: there is no boundary.
        """
        depth = self._depth(which, self.patch(which, point_world))
        node = which
        for _ in range(int(self.solid.sum())):
            reached = torch.nonzero(torch.isfinite(depth) & (node >= 0)).squeeze(-1)
            if not len(reached):
                break
            far = (point_world - depth[:, None] * normal_world)[reached]
            following, more = self._flush(node[reached], far.detach(), normal_world[reached])
            depth = depth.index_add(0, reached, more)
            node = node.index_copy(0, reached, following)
        return torch.where(self._covered(which, point_world + PROBE * normal_world), 0.0, depth)

    @torch.no_grad()
    def _covered(self, which: Tensor, point: Tensor) -> Bool[Tensor, "m"]:
        """Points inside another solid of each node's medium."""
        covered = torch.zeros_like(which, dtype=torch.bool)
        for slot in self.adjacent.unbind(1):
            i = torch.nonzero(slot[which] >= 0).squeeze(-1)
            covered[i] |= self.sdf(slot[which[i]], point[i]) < 0
        return covered

    def _flush(
        self, which: Tensor, point: Tensor, normal: Tensor
    ) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
        """The solid of the same medium that has, at points, a face looking along ``normal``, or -1;
        and how deep it is there."""
        following, depth = torch.full_like(which, -1), torch.zeros_like(point[:, 0])
        for slot in self.adjacent.unbind(1):
            i = torch.nonzero(slot[which] >= 0).squeeze(-1)
            i = i[self.sdf(slot[which[i]], point[i]).abs() <= FLUSH]
            node = slot[which[i]]
            for patch in range(self._most_planes(node)):
                face = torch.full_like(node, patch)
                n, offset, planar = self.plane(node, face)
                on = planar & ((n - normal[i]).abs().amax(-1) <= PARALLEL)
                on &= ((n * point[i]).sum(-1) - offset).abs() <= FLUSH
                following[i[on]] = node[on]
                depth = depth.index_copy(0, i[on], self._depth(node[on], face[on]))
        return following, depth

    def _most_planes(self, which: Tensor) -> int:
        shapes = [self.scene.nodes[k].body.shape for k in torch.unique(which).tolist()]
        return max((len(shape.planes()) for shape in shapes), default=0)

    @cached_property
    def adjacent(self) -> Int[Tensor, "n k"]:
        """Solids of the same medium that may touch each node, by their hulls; -1 pads."""
        low, high = self.bounds_object.detach().unbind(1)
        bounded = torch.isfinite(low).all(-1) & torch.isfinite(high).all(-1)
        every = torch.arange(len(self), device=self.device)
        centre = torch.where(bounded[:, None], 0.5 * (low + high), 0.0)
        half = torch.where(bounded[:, None], 0.5 * (high - low), math.inf)
        centre = self.point_world(every, centre).detach()
        turned = torch.einsum("nij,nj->ni", self.rotation.detach().abs(), half.nan_to_num())
        reach = torch.where(bounded[:, None], turned * self.scale[:, None].detach(), math.inf)
        near = self.solid[:, None] & (self.medium[:, None] == self.medium[None])
        near &= every[:, None] != every[None]
        for a in range(3):
            gap = (centre[:, None, a] - centre[None, :, a]).abs()
            near &= gap <= reach[:, None, a] + reach[None, :, a] + FLUSH
        count = int(near.sum(1).max()) if len(self) else 0
        order = torch.argsort(near, dim=1, descending=True, stable=True)[:, :count]
        return torch.where(near.gather(1, order), order, -1)

    def _depth(self, which: Tensor, patch: Tensor) -> Float[Tensor, "m"]:
        """``depth_behind`` of each node's own shape, in the world [m]."""
        depth = torch.zeros_like(self.scale[which])
        for shape, i in self.groups(which):
            depth = depth.index_copy(0, i, depth_behind(shape, patch[i]))
        bounded = torch.isfinite(depth)  # infinity times a scale would have no gradient
        scaled = torch.where(bounded, depth, 1.0) * self.scale[which]
        return torch.where(bounded, scaled, depth)


CROWDED = 20_000  # pairs of a point and a triangle of one sheet: a call of its own costs less
_CONTACT = tuple(Contact.__dataclass_fields__)
FLUSH = 1e-8  # [m] faces this near to each other touch
PROBE = 1e-6  # [m] before a face: what is there


def unit(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """vector / |vector|, and zero (with zero gradient) for the zero vector."""
    square = (vector * vector).sum(-1, keepdim=True)
    zero = square == 0
    inverse = torch.where(zero, torch.zeros_like(square), torch.where(zero, 1.0, square).rsqrt())
    return vector * inverse


def _present(number: Int[Tensor, "m"]) -> list[int]:
    """The numbers that occur, in order."""
    return torch.nonzero(torch.bincount(number)).squeeze(-1).tolist()


def _complex(which: Tensor, frequency: Tensor) -> Tensor:
    shape = (which.shape[0], frequency.shape[0], 2)
    return torch.zeros(shape, dtype=torch.complex128, device=which.device)


def _stack(items: list[Tensor], shape: tuple[int, ...], device: torch.device) -> Tensor:
    if not items:
        return torch.zeros((0, *shape), dtype=torch.float64, device=device)
    return torch.stack([x.to(device=device, dtype=torch.float64) for x in items])


def _distinct(
    keyed: list[tuple[object, Any]], device: torch.device
) -> tuple[list[Any], Int[Tensor, "n"]]:
    """Things that share a key, once each, and which of them every node has."""
    index: dict[object, int] = {}
    things, owner = [], []
    for key, thing in keyed:
        if key not in index:
            index[key] = len(things)
            things.append(thing)
        owner.append(index[key])
    return things, torch.tensor(owner, dtype=torch.int64, device=device)


def _with_numerics(body: Body, samples: int | None, integral: str, diffuse: bool) -> Body:
    refined = getattr(body.surface, "with_numerics", None)
    if refined is None or samples is None:
        return body
    return Body(body.shape, refined(samples, integral, diffuse))


def _shape_key(body: Body) -> tuple[object, Shape | None]:
    """What is asked in one call: all boxes, all sheets, or one shape of another kind."""
    if isinstance(body.shape, Box):
        return "boxes", None
    return ("sheets", None) if pooled(body.shape) else (id(body.shape), body.shape)


def _is_on(body: Body, device: torch.device) -> bool:
    """Whether all tensors of a body are on a device: asked in a tenth of the time that moving takes."""
    modules = (body, *body._modules.values())
    tables = [t for m in modules if m is not None for t in (m._parameters, m._buffers)]
    return pooled(body.shape) and all(
        x is None or x.device == device for table in tables for x in table.values()
    )


def pooled(shape: Shape) -> bool:
    """Whether a shape is asked together with others of its kind: a sheet that nobody fits."""
    return isinstance(shape, Sheet) and not shape.vertices.requires_grad


def _surface_key(body: Body, known: dict[int, object]) -> object:
    """Known materials of equal constants answer alike; a learned one belongs to its shape. ``known``: the
    keys of surfaces that were asked before."""
    surface = body.surface
    if id(surface) in known:
        return known[id(surface)]
    fitted = isinstance(surface, nn.Module) and any(p.requires_grad for p in surface.parameters())
    if fitted or surface.kind == "stochastic":
        return (id(surface), id(body.shape))
    known[id(surface)] = (surface.kind, json.dumps(surface.config(), sort_keys=True))
    return known[id(surface)]


def _medium_key(body: Body) -> tuple[object, Body]:
    """Solids of equal constants are one medium; while constants are being fitted, those that share
    them. Whatever is no solid has no medium: one key for all."""
    surface = body.surface
    if not isinstance(surface, Solid):
        return None, body
    if any(p.requires_grad for p in surface.medium.parameters()):
        return id(surface.medium), body
    return json.dumps(surface.medium.config(), sort_keys=True), body
