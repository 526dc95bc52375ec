"""The scene asks its objects' questions, by index, in the world frame.

World-to-object happens here and nowhere else, and so does grouping a batch: points of all nodes
that share a shape or a surface go to it in one call. Frames are float64 always; a shape may be asked
in float32.
"""

import json
from collections.abc import Callable, Iterator
from typing import Any

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor, nn

from rfsg.objects.body import Body
from rfsg.objects.contract import Contact, Crossing, Jet, Shape
from rfsg.objects.shapes.analytic import Box, Boxes, HalfSpace
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
            body.to(self.device)
        self.shapes, self.shape_of_node = _distinct(
            [_shape_key(n.body) for n in nodes], self.device
        )
        bodies, self.surface_of_node = _distinct([_surface_key(n.body) for n in nodes], self.device)
        self.surfaces = [_with_numerics(b, samples, integral, diffuse) for b in bodies]
        boxes = [n.body.shape for n in nodes if isinstance(n.body.shape, Box)]
        self.half_size = _stack([b.half_size for b in boxes], (3,), self.device)
        is_box = torch.tensor([isinstance(n.body.shape, Box) for n in nodes], device=self.device)
        self.box_of_node = torch.cumsum(is_box.long(), 0) - 1
        self.bounds_object = _stack([n.body.shape.bounds() for n in nodes], (2, 3), self.device)
        self.exact = self._flags(lambda b: b.shape.exact)
        self.flat = self._flags(lambda b: isinstance(b.shape, (Box, HalfSpace)))
        self.convex = self._flags(lambda b: b.shape.convex)
        self.opaque = self._flags(lambda b: b.surface.opaque)
        self.learned_surface = self._flags(lambda b: b.surface.kind == "stochastic")
        self.lipschitz = torch.tensor(
            [n.body.shape.lipschitz for n in nodes], dtype=torch.float64, device=self.device
        )
        extent = self.bounds_object[:, 1] - self.bounds_object[:, 0]
        size = torch.where(torch.isfinite(extent), extent, torch.zeros_like(extent)).amax(-1)
        self.size = torch.where(size > 0, size, torch.ones_like(size)) * self.scale.detach()

    def __len__(self) -> int:
        return len(self.scene.nodes)

    def _flags(self, question: Callable[[Body], bool]) -> Bool[Tensor, "n"]:
        answers = [bool(question(n.body)) for n in self.scene.nodes]
        return torch.tensor(answers, dtype=torch.bool, device=self.device)

    def groups(self, which: Int[Tensor, "m"]) -> Iterator[tuple[Shape, Tensor]]:
        """(shape, positions in the batch) for every shape that the batch touches.

        All boxes of a scene come as one ``Boxes``, a row for each of their positions.
        """
        owner = self.shape_of_node[which]
        for k in torch.unique(owner).tolist():
            i = torch.nonzero(owner == k).squeeze(-1)
            shape = self.shapes[k]
            yield (Boxes(self.half_size[self.box_of_node[which[i]]]) if shape is None else shape), i

    def surface_groups(self, which: Int[Tensor, "m"]) -> Iterator[tuple[Body, Tensor]]:
        """(body, positions in the batch) for every surface; equal known materials are one."""
        owner = self.surface_of_node[which]
        for k in torch.unique(owner).tolist():
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
            if isinstance(shape, Boxes):
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
        local = Contact(
            self.point_object(which, contact.point),
            self.direction_object(which, contact.incoming),
            self.direction_object(which, contact.outgoing),
            self.direction_object(which, contact.normal),
        )
        for body, i in self.surface_groups(which):
            mine = Contact(local.point[i], local.incoming[i], local.outgoing[i], local.normal[i])
            yield body, i, mine

    def transmission(
        self, which: Int[Tensor, "m"], crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Complex[Tensor, "m f 2"]:
        """Transmission (TE, TM) relative to free space, of crossings given in the world."""
        out = _complex(which, frequency)
        local = self._crossing_object(which, crossing)
        for body, i in self.surface_groups(which):
            out = out.index_copy(0, i, body.transmission(_take(local, i), frequency).to(out.dtype))
        return out

    def excess_delay(
        self, which: Int[Tensor, "m"], crossing: Crossing, frequency: Float[Tensor, "f"]
    ) -> Float[Tensor, "m f"]:
        """Group delay beyond free space [s], of crossings given in the world."""
        out = torch.zeros(len(which), len(frequency), dtype=torch.float64, device=self.device)
        local = self._crossing_object(which, crossing)
        for body, i in self.surface_groups(which):
            out = out.index_copy(0, i, body.excess_delay(_take(local, i), frequency).to(out.dtype))
        return out

    def _crossing_object(self, which: Tensor, crossing: Crossing) -> Crossing:
        return Crossing(
            self.point_object(which, crossing.start),
            self.point_object(which, crossing.end),
            self.direction_object(which, crossing.normal_start),
            self.direction_object(which, crossing.normal_end),
        )


def unit(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """vector / |vector|, and zero (with zero gradient) for the zero vector."""
    square = (vector * vector).sum(-1, keepdim=True)
    zero = square == 0
    inverse = torch.where(zero, torch.zeros_like(square), torch.where(zero, 1.0, square).rsqrt())
    return vector * inverse


def _take(crossing: Crossing, i: Tensor) -> Crossing:
    return Crossing(
        crossing.start[i], crossing.end[i], crossing.normal_start[i], crossing.normal_end[i]
    )


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
    return ("boxes", None) if isinstance(body.shape, Box) else (id(body.shape), body.shape)


def _surface_key(body: Body) -> tuple[object, Body]:
    """Known materials of equal constants answer alike; a learned one belongs to its shape."""
    surface = body.surface
    fitted = isinstance(surface, nn.Module) and any(p.requires_grad for p in surface.parameters())
    if fitted or surface.kind == "stochastic":
        return (id(surface), id(body.shape)), body
    return (surface.kind, json.dumps(surface.config(), sort_keys=True)), body
