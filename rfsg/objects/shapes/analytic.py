"""Shapes with closed forms: box, sphere, cylinder, capsule, half-space.

Each is an exact signed distance (slope 1, negative inside) centred on its own origin, with value,
gradient and Hessian written out. Distances follow the usual construction of a rounded or boxed
region (Hart 1996, "Sphere tracing"): outside it is the distance to the nearest piece, inside the
distance to the nearest face.

Where a distance has no derivative (the centre of a sphere, the axis of a cylinder or capsule) the
gradient is zero, so that nothing is divided by nothing; on the inner ridges of a box or a cylinder
one of the nearest faces is chosen. Dimensions are float64 and ask for no gradients until told to.

Inside means sdf < 0: a line that runs in a face, or touches an edge, is not inside anywhere.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rfsg.objects.contract import Jet


class Analytic(nn.Module):
    """What all closed-form shapes share."""

    kind: str
    lipschitz: float = 1.0
    convex: bool = True
    faceted: bool = False
    exact: bool = True

    def sdf(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance [m]."""
        return self.value_and_gradient(point)[0]

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        """Signed distance [m] and its gradient [1]."""
        raise NotImplementedError

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Outward unit normal of the smooth piece nearest to a surface point."""
        return self.value_and_gradient(point)[1]

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        """The one smooth piece of a surface that has no edges: 0."""
        return torch.zeros(point.shape[:-1], dtype=torch.int64, device=point.device)

    def config(self) -> dict[str, object]:
        """Constructor arguments, ready for JSON."""
        return {name: value.tolist() for name, value in self.named_parameters()}


class Box(Analytic):
    """Axis-aligned box |x| <= half_size [m]; patches -x, +x, -y, +y, -z, +z, all planar.

    Raises ValueError unless half_size holds three positive finite lengths.
    """

    kind = "box"
    faceted = True

    def __init__(self, half_size: Sequence[float] | Tensor):
        super().__init__()
        self.half_size = _length("Box", "half_size", half_size, (3,))

    def bounds(self) -> Float[Tensor, "2 3"]:
        return torch.stack([-self.half_size, self.half_size])

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        _, q = self._beyond(point)
        value, slope = _corner(q)
        return value, slope * _sign(point)

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        _, q = self._beyond(point)
        sign = _sign(point)
        value, slope = _corner(q)
        bend = _corner_hessian(q, slope)
        return Jet(value, slope * sign, sign[..., :, None] * bend * sign[..., None, :])

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        enter, leave = _slab(origin, direction, self.half_size.to(origin))
        return _or_miss(enter.amax(-1), leave.amin(-1))

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Normal of the face of largest |x| - half_size, also on edges and corners."""
        _, q = self._beyond(point)
        return _one_hot(q) * _sign(point)

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        _, q = self._beyond(point)
        axis = q.argmax(-1, keepdim=True)
        return (2 * axis + (point.gather(-1, axis) > 0)).squeeze(-1)

    def planes(self) -> Float[Tensor, "6 4"]:
        eye = torch.eye(3, dtype=self.half_size.dtype, device=self.half_size.device)
        normal = torch.stack([-eye, eye], dim=1).reshape(6, 3)
        return torch.cat([normal, self.half_size.repeat_interleave(2)[:, None]], dim=1)

    def _beyond(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """half_size and |x| - half_size in the precision of the points."""
        half = self.half_size.to(point)
        return half, point.abs() - half


class Boxes(Box):
    """Many boxes at once, one per point: row i of every batch asks box i.

    A building is hundreds of boxes; asking each alone costs more in calls than in arithmetic.
    half_size [m 3]; batches are flat [m 3]. Differentiable in half_size.
    """

    half_size: Tensor

    def __init__(self, half_size: Float[Tensor, "m 3"]):
        nn.Module.__init__(self)
        self.half_size = half_size

    def plane_of(self, patch: Int[Tensor, "m"]) -> Float[Tensor, "m 4"]:
        """Row ``patch`` of each box's ``planes``."""
        axis = torch.div(patch, 2, rounding_mode="floor")[:, None]
        sign = 2.0 * (patch % 2).to(self.half_size.dtype) - 1.0
        normal = torch.zeros_like(self.half_size).scatter(1, axis, sign[:, None])
        return torch.cat([normal, self.half_size.gather(1, axis)], dim=1)


class Sphere(Analytic):
    """Ball of ``radius`` [m]. Raises ValueError unless the radius is positive and finite."""

    kind = "sphere"

    def __init__(self, radius: float | Tensor):
        super().__init__()
        self.radius = _length("Sphere", "radius", radius, ())

    def bounds(self) -> Float[Tensor, "2 3"]:
        return torch.stack([-self.radius, self.radius])[:, None].expand(2, 3)

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        length, unit = _polar(point)
        return length - self.radius.to(point), unit

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        length, unit = _polar(point)
        bend = _tangential(unit, torch.ones_like(point)) * _inverse(length)[..., None, None]
        return Jet(length - self.radius.to(point), unit, bend)

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        return _ball(origin, direction, self.radius.to(origin))

    def planes(self) -> Float[Tensor, "0 4"]:
        return self.radius.new_zeros(0, 4)


class Cylinder(Analytic):
    """Capped cylinder about z, |z| <= half_height, of ``radius`` [m].

    Patches: 0 the cap at -z, 1 the cap at +z (planar), 2 the side. Raises ValueError unless both
    lengths are positive and finite.
    """

    kind = "cylinder"

    def __init__(self, radius: float | Tensor, half_height: float | Tensor):
        super().__init__()
        self.radius = _length("Cylinder", "radius", radius, ())
        self.half_height = _length("Cylinder", "half_height", half_height, ())

    def bounds(self) -> Float[Tensor, "2 3"]:
        high = torch.stack([self.radius, self.radius, self.half_height])
        return torch.stack([-high, high])

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        _, outward, q = self._meridian(point)
        value, slope = _corner(q)
        return value, self._lift(slope, outward, point)

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        """In the meridian plane f = F(rho, z); the lift adds F_rho / rho around the axis."""
        rho, outward, q = self._meridian(point)
        value, slope = _corner(q)
        bend = _corner_hessian(q, slope)
        sign = _sign(point[..., 2])
        axis = point.new_tensor([0.0, 0.0, 1.0]).expand_as(point) * sign[..., None]
        frame = torch.stack([outward, axis], dim=-2)
        meridian = frame.mT @ bend @ frame
        around = _tangential(outward, point.new_tensor([1.0, 1.0, 0.0]).expand_as(point))
        ring = (slope[..., 0] * _inverse(rho))[..., None, None] * around
        return Jet(value, self._lift(slope, outward, point), meridian + ring)

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        return _tube(origin, direction, self.radius.to(origin), self.half_height.to(origin))

    def normal_at(self, point: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Normal of the cap or the side, whichever is nearer, also on the rims."""
        _, outward, q = self._meridian(point)
        return self._lift(_one_hot(q), outward, point)

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        _, _, q = self._meridian(point)
        cap = (point[..., 2] > 0).to(torch.int64)
        return torch.where(q[..., 0] > q[..., 1], torch.full_like(cap, 2), cap)

    def planes(self) -> Float[Tensor, "2 4"]:
        rows = self.radius.new_tensor([[0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
        return torch.cat([rows[:, :3], self.half_height.expand(2, 1)], dim=1)

    def _meridian(self, point: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distance from the axis, unit vector away from it, and (rho - radius, |z| - height)."""
        rho, around = _polar(point[..., :2])
        outward = torch.cat([around, torch.zeros_like(point[..., 2:])], dim=-1)
        beyond_side = rho - self.radius.to(point)
        beyond_cap = point[..., 2].abs() - self.half_height.to(point)
        return rho, outward, torch.stack([beyond_side, beyond_cap], dim=-1)

    @staticmethod
    def _lift(slope: Tensor, outward: Tensor, point: Tensor) -> Tensor:
        up = torch.zeros_like(point[..., :2])
        along = torch.cat([up, (slope[..., 1] * _sign(point[..., 2]))[..., None]], dim=-1)
        return slope[..., :1] * outward + along


class Capsule(Analytic):
    """All points within ``radius`` of the segment |z| <= half_height on the z axis [m].

    Patches: 0 the side, 1 the lower cap, 2 the upper cap. Raises ValueError unless both lengths are
    positive and finite.
    """

    kind = "capsule"

    def __init__(self, radius: float | Tensor, half_height: float | Tensor):
        super().__init__()
        self.radius = _length("Capsule", "radius", radius, ())
        self.half_height = _length("Capsule", "half_height", half_height, ())

    def bounds(self) -> Float[Tensor, "2 3"]:
        high = torch.stack([self.radius, self.radius, self.half_height + self.radius])
        return torch.stack([-high, high])

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        length, unit = _polar(self._from_segment(point))
        return length - self.radius.to(point), unit

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        length, unit = _polar(self._from_segment(point))
        in_cap = (point[..., 2:].abs() > self.half_height.to(point)).to(point.dtype)
        free = torch.cat([torch.ones_like(point[..., :2]), in_cap], dim=-1)
        bend = _tangential(unit, free) * _inverse(length)[..., None, None]
        return Jet(length - self.radius.to(point), unit, bend)

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        """Hull of the stretches in the tube and the two balls: their union is convex."""
        radius, half = self.radius.to(origin), self.half_height.to(origin)
        up = torch.cat(
            [torch.zeros_like(origin[..., :2]), half.expand(origin.shape[:-1])[..., None]], -1
        )
        pieces = [
            _tube(origin, direction, radius, half),
            _ball(origin - up, direction, radius),
            _ball(origin + up, direction, radius),
        ]
        enter, leave = (torch.stack(ends) for ends in zip(*pieces, strict=True))
        return enter.amin(0), leave.amax(0)

    def patch(self, point: Float[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
        half = self.half_height.to(point)
        lower, upper = point[..., 2] < -half, point[..., 2] > half
        return lower.to(torch.int64) + 2 * upper.to(torch.int64)

    def planes(self) -> Float[Tensor, "0 4"]:
        return self.radius.new_zeros(0, 4)

    def _from_segment(self, point: Tensor) -> Tensor:
        half = self.half_height.to(point)
        z = point[..., 2]
        rest = torch.where(z.abs() > half, z - _sign(z) * half, torch.zeros_like(z))
        return torch.cat([point[..., :2], rest[..., None]], dim=-1)


class HalfSpace(Analytic):
    """Everything below the plane z = 0: ground, or a very thick wall. Unbounded."""

    kind = "halfspace"
    faceted = True
    _bounds: Tensor
    _planes: Tensor

    def __init__(self) -> None:
        super().__init__()
        inf = math.inf
        corners = torch.tensor([[-inf, -inf, -inf], [inf, inf, 0.0]], dtype=torch.float64)
        plane = torch.tensor([[0.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
        self.register_buffer("_bounds", corners, persistent=False)
        self.register_buffer("_planes", plane, persistent=False)

    def bounds(self) -> Float[Tensor, "2 3"]:
        return self._bounds

    def value_and_gradient(
        self, point: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b 3"]]:
        return point[..., 2], point.new_tensor([0.0, 0.0, 1.0]).expand_as(point)

    def jet(self, point: Float[Tensor, "*b 3"]) -> Jet:
        value, gradient = self.value_and_gradient(point)
        return Jet(value, gradient, point.new_zeros(*point.shape, 3))

    def interval(
        self, origin: Float[Tensor, "*b 3"], direction: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
        parallel, slope = _divisor(direction[..., 2])
        height = origin[..., 2]
        cut = -height / slope
        inf = torch.full_like(cut, math.inf)
        under = parallel & (height < 0)
        enter = torch.where(
            under | (~parallel & (slope > 0)), -inf, torch.where(parallel, inf, cut)
        )
        leave = torch.where(
            under | (~parallel & (slope < 0)), inf, torch.where(parallel, -inf, cut)
        )
        return enter, leave

    def planes(self) -> Float[Tensor, "1 4"]:
        return self._planes


def _length(shape: str, name: str, value: object, size: tuple[int, ...]) -> nn.Parameter:
    """A checked dimension [m]: float64, not asking for gradients until somebody fits it."""
    given = torch.as_tensor(value, dtype=torch.float64).detach().clone()
    if tuple(given.shape) != size or not bool((torch.isfinite(given) & (given > 0)).all()):
        count = "three positive finite lengths" if size else "one positive finite length"
        raise ValueError(f"{shape} {name}={value!r}: expected {count} in metres")
    return nn.Parameter(given, requires_grad=False)


def _sign(x: Tensor) -> Tensor:
    """+1 or -1, never 0: on a mirror plane one side is chosen."""
    return torch.where(x < 0, -torch.ones_like(x), torch.ones_like(x))


def _one_hot(q: Tensor) -> Tensor:
    return torch.zeros_like(q).scatter(-1, q.argmax(-1, keepdim=True), 1.0)


def _polar(vector: Tensor) -> tuple[Tensor, Tensor]:
    """Length and unit vector; the zero vector has length 0, unit 0 and finite derivatives."""
    square = (vector * vector).sum(-1)
    nonzero = square > 0
    length = torch.where(nonzero, torch.where(nonzero, square, torch.ones_like(square)).sqrt(), 0.0)
    return length, vector * _inverse(length)[..., None]


def _inverse(length: Tensor) -> Tensor:
    """1/length, and 0 at length 0."""
    nonzero = length > 0
    return torch.where(nonzero, 1.0 / torch.where(nonzero, length, torch.ones_like(length)), 0.0)


def _corner(q: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and slope for the corner q <= 0: |max(q, 0)| off an edge, else the largest q."""
    length, unit = _polar(q.clamp(min=0.0))
    off_edge = _off_edge(q)
    value = torch.where(off_edge, length, q.amax(-1))
    return value, torch.where(off_edge[..., None], unit, _one_hot(q))


def _corner_hessian(q: Tensor, slope: Tensor) -> Tensor:
    """Second derivative of ``_corner``: (P - n n) / distance off an edge, 0 off a face."""
    length, _ = _polar(q.clamp(min=0.0))
    bend = _tangential(slope, (q > 0).to(q.dtype)) * _inverse(length)[..., None, None]
    return torch.where(_off_edge(q)[..., None, None], bend, torch.zeros_like(bend))


def _off_edge(q: Tensor) -> Tensor:
    """Whether an edge or a corner is nearest; decided by count, so a flat face is flat exactly."""
    beyond = q > 0
    squares = q * q * beyond
    return (beyond.sum(-1) > 1) & (squares.sum(-1) > 0)


def _tangential(unit: Tensor, free: Tensor) -> Tensor:
    """diag(free) - n n: the projector along the surface, within the directions that are free."""
    return torch.diag_embed(free) - unit[..., :, None] * unit[..., None, :]


def _divisor(x: Tensor) -> tuple[Tensor, Tensor]:
    """Which components are parallel (as good as 0), and x with 1 in their place.

    The threshold is the fourth root of the smallest normal number: above it 1/x and its derivative
    1/x^2 are finite; below it a ray does not move measurably over any length (1e-77 in float64).
    """
    parallel = x.abs() < torch.finfo(x.dtype).tiny ** 0.25
    return parallel, torch.where(parallel, torch.ones_like(x), x)


def _slab(origin: Tensor, direction: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where |origin + t direction| < half, component by component."""
    parallel, slope = _divisor(direction)
    side = _sign(slope) * half
    enter, leave = (-side - origin) / slope, (side - origin) / slope
    always = origin.abs() < half
    inf = torch.full_like(enter, math.inf)
    unlimited = torch.where(always, -inf, inf)
    return torch.where(parallel, unlimited, enter), torch.where(parallel, -unlimited, leave)


def _ball(origin: Tensor, direction: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Where a line is within ``radius`` of the origin, in as many dimensions as it has.

    From the foot of the perpendicular, so nothing cancels when the origin is far away.
    """
    speed, unit = _polar(direction)
    parallel, speed = _divisor(speed)
    middle = -(origin * unit).sum(-1)
    foot = origin + middle[..., None] * unit
    inside = radius * radius - (foot * foot).sum(-1)
    hit = inside > 0
    half = torch.where(hit, inside, torch.ones_like(inside)).sqrt()
    inf = torch.full_like(half, math.inf)
    enter = torch.where(parallel, -inf, (middle - half) / speed)
    leave = torch.where(parallel, inf, (middle + half) / speed)
    return torch.where(hit, enter, inf), torch.where(hit, leave, -inf)


def _tube(origin: Tensor, direction: Tensor, radius: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    around = _ball(origin[..., :2], direction[..., :2], radius)
    along = _slab(origin[..., 2], direction[..., 2], half)
    return _or_miss(torch.maximum(around[0], along[0]), torch.minimum(around[1], along[1]))


def _or_miss(enter: Tensor, leave: Tensor) -> tuple[Tensor, Tensor]:
    hit = enter < leave
    inf = torch.full_like(enter, math.inf)
    return torch.where(hit, enter, inf), torch.where(hit, leave, -inf)
