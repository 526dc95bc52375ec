"""The fast ways of planar scenes, each against a plain twin."""

from dataclasses import replace

import pytest
import torch

from rfsg.objects.contract import Contact
from rfsg.scene.pose import Pose
from rfsg.scene.radios import field_components
from rfsg.scene.scene import Scene
from rfsg.scene.world import World, unit
from rfsg.tracer import passages as passing
from rfsg.tracer.acting import dyad_of
from rfsg.tracer.apart import traced
from rfsg.tracer.columns import columns
from rfsg.tracer.embree import Proxies, brute_spans
from rfsg.tracer.faces import planes_of
from rfsg.tracer.jones import acted
from rfsg.tracer.march import EVALUATE, crossings
from rfsg.tracer.mirrored import folded, mirrors_of, stacked, within_sides
from rfsg.tracer.plan import Quality
from rfsg.tracer.ports import Antennas
from rfsg.tracer.reached import reached
from rfsg.tracer.records import Chains, Rays
from rfsg.tracer.seams import coincident
from rfsg.tracer.sequences import Budget, levels
from rfsg.tracer.simulate import simulate
from tests.laws.test_simulation_laws import furnished
from tests.scenes import box_node, radio, room, room_nodes, vector


def draw(seed: int, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, dtype=torch.float64, generator=generator)


def places(seed: int, count: int) -> torch.Tensor:
    return 0.1 + draw(seed, count, 3) * (vector(6.0, 4.0, 3.0) - 0.2)


def turned_boxes() -> Scene:
    """Boxes at odd angles in a room."""
    boxes = [
        box_node(f"/b{k}", (1.2 + 1.3 * k, 1.1 + 0.6 * k, 0.7), (0.4, 0.2, 0.6), yaw_deg=27.0 * k)
        for k in range(3)
    ]
    tilted = replace(
        boxes[1],
        pose=Pose(
            torch.linalg.qr(draw(3, 3, 3)).Q @ torch.diag(vector(1.0, 1.0, 1.0)),
            boxes[1].pose.translation,
            boxes[1].pose.scale,
        ),
    )
    return Scene((*room_nodes(), boxes[0], tilted, boxes[2]), (), (), 2.4e9)


# the search


def passes(planes, faces: list[int], source, target) -> bool:
    """Mirror the source in one face after the other, then fold the path back, a face at a time."""
    images = [source]
    for f in faces:
        height = images[-1] @ planes.normal[f] - planes.offset[f]
        images.append(images[-1] - 2.0 * height * planes.normal[f])
    for level in range(len(faces) - 1, -1, -1):
        f, image = faces[level], images[level + 1]
        before = image @ planes.normal[f] - planes.offset[f]
        after = target @ planes.normal[f] - planes.offset[f]
        if not (before < 0 < after):
            return False
        target = image + before / (before - after) * (target - image)
        if bool(((planes.edges[f] @ (target - planes.centre[f])).abs() > planes.half[f]).any()):
            return False
    return True


@pytest.mark.parametrize("scene", [turned_boxes(), room()])
def test_points_reached_are_those_of_the_image_method(scene):
    planes = planes_of(World(scene))
    source, targets = vector(1.31, 2.11, 1.73), places(5, 3)
    for prefixes in levels(planes, source, 2, Budget(10**9))[1:]:
        row, column = reached(planes, prefixes.image, prefixes.faces, targets)
        found = set(zip(row.tolist(), column.tolist(), strict=True))
        expected = {
            (p, n)
            for p, faces in enumerate(prefixes.faces.tolist())
            for n in range(len(targets))
            if passes(planes, faces, source, targets[n])
        }
        assert found == expected and found


def test_nobody_is_reached_where_there_is_nobody():
    planes = planes_of(World(room()))
    (_, one) = levels(planes, vector(1.0, 1.0, 1.0), 1, Budget(10**9))
    for count, image in ((0, one.image), (3, one.image[:0])):
        row, column = reached(planes, image, one.faces[: len(image)], places(1, count))
        assert len(row) == len(column) == 0


# the image method


def test_planar_patches_are_numbered_first():
    world = World(furnished())
    node = torch.arange(len(world)).repeat_interleave(6)
    patch = torch.arange(6).repeat(len(world))
    assert torch.equal(world.is_planar(node, patch), world.plane(node, patch)[2])


def test_sides_of_rectangles_say_what_the_distance_says():
    """A point in a face's plane is as far from the box as it is beyond the face's sides."""
    world, planes = World(turned_boxes()), planes_of(World(turned_boxes()))
    face = torch.arange(len(planes)).repeat_interleave(200)
    spread = 3.0 * (draw(9, len(face), 2) - 0.5) * planes.half[face]
    point = planes.centre[face] + torch.einsum("mi,mij->mj", spread, planes.edges[face])
    distance = world.sdf(planes.node[face], point)
    for tolerance in (1e-7, 0.05):
        limit = torch.full_like(distance, tolerance)
        within = within_sides(world, planes.node[face], planes.patch[face], columns(point), limit)
        clear = (distance - tolerance).abs() > 1e-9
        assert torch.equal(within[clear], (distance <= tolerance)[clear])
        assert within.any() and not within.all()


def test_folded_paths_reflect_at_equal_angles():
    """Each vertex lies on its plane, and both rays make one angle with it."""
    world = World(turned_boxes())
    which = torch.randint(0, 9, (50, 3), generator=torch.Generator().manual_seed(1))
    patch = torch.randint(0, 6, (50, 3), generator=torch.Generator().manual_seed(2))
    path = folded(mirrors_of(world), which, patch, places(3, 50), places(4, 50))
    x, n = stacked(path.vertices), stacked(path.normals)
    for level in range(3):
        normal, offset, _ = world.plane(which[:, level], patch[:, level])
        torch.testing.assert_close(n[:, level], normal)
        torch.testing.assert_close((x[:, level + 1] * normal).sum(-1), offset, rtol=0, atol=1e-7)
    step = x[:, 1:] - x[:, :-1]
    apart = (step.norm(dim=-1) > 1e-3).all(1)  # not twice running in one plane
    step, n = step[apart], n[apart]
    # a vertex may lie beyond the end it should come before: then its ray points the other way
    cosine = [(unit(step[:, k + s]) * n[:, k]).sum(-1).abs() for s in (0, 1) for k in range(3)]
    for k in range(3):
        torch.testing.assert_close(cosine[k], cosine[k + 3], rtol=0, atol=1e-6)


def test_image_method_has_the_gradients_of_its_path():
    world = World(room())
    which, patch = torch.tensor([[1, 3, 0]]), torch.tensor([[0, 2, 1]])

    def of(tx, rx):
        path = folded(mirrors_of(world), which, patch, tx, rx)
        return stacked(path.vertices), path.length

    ends = [vector(1.3, 2.1, 1.7)[None], vector(4.4, 1.2, 0.6)[None]]
    assert torch.autograd.gradcheck(of, [e.requires_grad_() for e in ends])


# nothing in the way


def segments_about(scene: Scene, seed: int) -> Rays:
    """Segments between points in the room, points on its faces and points in its corners."""
    start, end = places(seed, 300), places(seed + 1, 300)
    size = vector(6.0, 4.0, 3.0)
    for points in (start[:200], end[100:]):
        axis = (3 * draw(seed + 2, len(points))).long()
        points[torch.arange(len(points)), axis] = size[axis] * (draw(seed, len(points)) > 0.5)
    start[-20:, 2] = end[-20:, 2] = 0.0  # along the floor
    start[-20:-10, 1] = end[-20:-10, 1] = 0.0  # and in the corner with a wall
    length = (end - start).norm(dim=-1)
    return Rays(start, unit(end - start), length)


@pytest.mark.parametrize("scene", [furnished(), turned_boxes(), room(), Scene((), (), (), 1e9)])
def test_what_is_proven_clear_is_crossed_by_nothing(scene):
    world = World(scene)
    for seed in range(3):
        rays = segments_about(scene, 10 * seed)
        row, nodes = traced(world, rays)
        found = crossings(world, rays, brute_spans(world, rays), EVALUATE)
        assert bool(torch.isin(found.ray, row).all())
        assert bool(nodes[found.which].all())


def test_an_empty_room_needs_no_tracing():
    world = World(room())
    inside = Rays(*(torch.cat(x) for x in zip(*(
        (p, unit(q - p), (q - p).norm(dim=-1)) for p, q in ((places(1, 40), places(2, 40)),)
    ), strict=True)))  # fmt: skip
    row, nodes = traced(world, inside)
    assert len(row) == 0 and not nodes.any()


@pytest.mark.parametrize("scene", [furnished(), turned_boxes()])
def test_crossings_are_those_of_tracing_everything(scene, monkeypatch):
    world, rays = World(scene), segments_about(scene, 4)
    one = passing.every_crossing(world, Proxies(world), rays, Quality(chunk=64))
    every = lambda world, rays: (torch.arange(len(rays.limit)), torch.ones(len(world)).bool())  # noqa: E731
    monkeypatch.setattr(passing, "traced", every)
    other = passing.every_crossing(world, Proxies(world), rays, Quality())
    for name in ("ray", "which", "enter", "leave", "normal_enter", "normal_leave"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=0)


# fields


def test_a_dyad_applied_is_the_dyad():
    incoming, normal = (unit(draw(k, 20, 3) - 0.5) for k in (1, 2))
    mirrored = incoming - 2.0 * (incoming * normal).sum(-1, keepdim=True) * normal
    incoming[0] = -normal[0]  # without a plane of incidence
    mirrored[0] = normal[0]
    pair = torch.complex(draw(3, 20, 2, 2), draw(4, 20, 2, 2))
    field = draw(5, 3, 2, 2, 2, 20)  # xyz, re/im, sent, f, paths
    whole = torch.complex(field[:, 0], field[:, 1]).permute(3, 2, 0, 1)
    for outgoing in (mirrored, incoming):
        expected = dyad_of(pair, incoming, outgoing, normal) @ whole
        ways = (columns(v) for v in (incoming, outgoing, normal))
        after = torch.stack(acted(pair, *ways, list(field)))
        after = torch.complex(after[:, 0], after[:, 1]).permute(3, 2, 0, 1)
        torch.testing.assert_close(after, expected, rtol=1e-13, atol=1e-13)


def test_a_dyad_applied_has_its_gradients():
    incoming, normal = (unit(draw(k, 3, 3) - 0.5) for k in (1, 2))
    outgoing = incoming - 2.0 * (incoming * normal).sum(-1, keepdim=True) * normal
    pair = torch.complex(draw(3, 3, 1, 2), draw(4, 3, 1, 2))
    field = draw(5, 3, 2, 2, 1, 3)

    def of(pair, incoming, outgoing, normal, field):
        ways = (columns(v) for v in (incoming, outgoing, normal))
        return torch.stack(acted(pair, *ways, list(field)))

    inputs = [x.requires_grad_() for x in (pair, incoming, outgoing, normal, field)]
    assert torch.autograd.gradcheck(of, inputs)


def test_radios_that_are_alike_answer_as_each_alone():
    radios = tuple(
        radio(f"/r{k}", 0.0, 0.0, 0.0, pattern=pattern, polarization=pol, rotation=turn)
        for k, (pattern, pol, turn) in enumerate(
            (pattern, pol, turn)
            for pattern in ("isotropic", "tr38901")
            for pol in ("V", "+45")
            for turn in (torch.eye(3).double(), torch.linalg.qr(draw(7, 3, 3)).Q)
        )
    )
    index = torch.arange(len(radios)).repeat(5)
    direction = unit(draw(8, len(index), 3) - 0.5)
    antennas = Antennas(radios, torch.device("cpu"))
    assert len(antennas.kinds) == len(radios) and len(Antennas(radios * 3, index.device).kinds) == 8
    answer, gain = antennas.components(index, direction), antennas.patterns(index, direction)
    for p, r in enumerate(index.tolist()):
        local = direction[p] @ radios[r].rotation
        alone = field_components(radios[r], local)[0]
        torch.testing.assert_close(answer[p], alone)
        torch.testing.assert_close(gain[p], alone.abs().square().sum().sqrt())


@pytest.mark.parametrize("polarization", ["none", "V"])
def test_chunks_change_nothing(polarization):
    ends = tuple(radio(f"/{k}", *p, polarization=polarization) for k, p in enumerate(places(2, 6)))
    scene = replace(turned_boxes(), transmitters=ends[:1], receivers=ends[1:])
    one, many = (simulate(scene, quality=Quality(depth=2, chunk=c)) for c in (65_536, 32))
    for name in ("gain", "delay", "crossed", "blocked", "doppler", "jones"):
        a, b = getattr(one.channel, name), getattr(many.channel, name)
        assert (a is None) == (b is None)
        if a is not None:
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-15)


# seams


def test_paths_whose_coordinates_have_equal_sums_are_not_one():
    """Rounded coordinates are mixed into one number for each path: small changes that cancel in a
    weighted sum must not make two paths one (they did, five of 231,000 in a room at depth 5)."""
    world = World(room())
    seed = torch.zeros(2, 1, 3, dtype=torch.float64)
    ends, wall = torch.zeros(2, dtype=torch.int64), torch.zeros(2, 1, dtype=torch.int64)
    chains = Chains(ends, ends, wall, torch.ones_like(wall), seed)
    normal = vector(1.0, 0.0, 0.0).expand(2, 1, 3).clone()
    good = torch.ones(2, dtype=torch.bool)
    for a in range(3):
        for b in range(3):
            if a == b:
                continue
            vertices = torch.ones(2, 3, 3, dtype=torch.float64)
            weight = 11 + 2 * torch.arange(3)
            vertices[1, 1, a] += 1e-3 * float(weight[b])
            vertices[1, 1, b] -= 1e-3 * float(weight[a])
            assert not coincident(world, chains, vertices, normal, good).any()
    assert int(coincident(world, chains, vertices[:1].repeat(2, 1, 1), normal, good).sum()) == 1


def test_known_materials_answer_the_same_in_every_frame():
    world = World(turned_boxes())
    which = torch.tensor([6, 7, 8])
    incoming, normal = (unit(draw(k, 3, 3) - 0.5) for k in (1, 2))
    outgoing = incoming - 2.0 * (incoming * normal).sum(-1, keepdim=True) * normal
    contact = Contact(places(3, 3), incoming, outgoing, normal)
    frequency = vector(2.4e9, 28e9)
    for k, node in enumerate(which.tolist()):
        body = world.scene.nodes[node].body
        local = Contact(
            world.point_object(which, contact.point)[k],
            *(
                world.direction_object(which, v)[k]
                for v in (contact.incoming, contact.outgoing, contact.normal)
            ),
        )
        torch.testing.assert_close(
            world.reflection(which, contact, frequency)[k], body.reflection(local, frequency)
        )
