"""Radio maps: by rays against paths, on planes and surfaces, and what is read off them."""

import math

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Cylinder, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer.cells import grid_on, plane_through
from rfsg.tracer.channel import power, thermal_noise_dbm
from rfsg.tracer.montecarlo import estimate_power
from rfsg.tracer.patches import patches_from, patches_of
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import radio_map, radio_map_on
from rfsg.tracer.simulate import simulate
from tests.scenes import box_node, radio, room, vector

QUALITY = Quality(depth=1, map_rays=120_000, floor_db=-100.0)
FEWER = Quality(depth=1, map_rays=40_000, floor_db=-100.0)
BOUNDS = (0.0, 0.0, 6.0, 4.0)


def test_map_agrees_with_the_path_solver_within_its_error():
    scene = room()
    options = dict(height=1.2, cell=1.0, bounds=BOUNDS, quality=QUALITY)
    rays = radio_map(scene, 2.4e9, **options)
    paths = radio_map(scene, 2.4e9, method="paths", **options)
    assert rays.path_gain.shape == (1, 4, 6)
    assert bool(torch.isfinite(rays.error_db).all()) and bool((paths.error_db == 0).all())
    difference = (10 * torch.log10(rays.path_gain / paths.path_gain)).abs()
    # one standard deviation holds two cells in three, two hold all but one in twenty
    assert float((difference <= rays.error_db).double().mean()) >= 0.68
    assert float((difference <= 2 * rays.error_db).double().mean()) >= 0.95
    assert float(rays.error_db.median()) < 2.0


def test_seeds_scatter_within_the_reported_error():
    scene = room()
    options = dict(height=1.2, cell=1.0, bounds=BOUNDS, quality=FEWER)
    one, two = (radio_map(scene, 2.4e9, seed=s, **options) for s in (0, 1))
    again = radio_map(scene, 2.4e9, seed=0, **options)
    assert torch.equal(one.path_gain, again.path_gain)
    difference = (10 * torch.log10(one.path_gain / two.path_gain)).abs()
    assert float(difference.amax()) > 0.0
    assert bool((difference <= 3 * one.error_db).all())


FREE = dict(bounds=BOUNDS, quality=QUALITY, cell=2.0, method="paths")


def two_transmitters(*powers: float) -> Scene:
    places = ((1.0, 2.0, 1.2), (5.0, 2.0, 1.2))
    sent = [radio(f"/tx{i}", *p, power_dbm=d) for i, (p, d) in enumerate(zip(places, powers))]  # noqa: B905
    return Scene((), tuple(sent), ())


def friis_db(distance: float, f: float = 2.4e9) -> float:
    return 20 * math.log10(299_792_458.0 / f / (4 * math.pi * distance))


# what is read off a map


def test_path_loss_and_strength_in_free_space():
    """ITU-R P.525: 20 log10(4 pi d / lambda)."""
    found = radio_map(two_transmitters(20.0, 10.0), 2.4e9, **FREE)
    assert found.cells.shape == (2, 3)
    d = math.hypot(4.0, 1.0)  # from the first to the last column
    assert float(found.path_loss_db()[0, 0, 2]) == pytest.approx(-friis_db(d), abs=1e-9)
    assert float(found.rss_dbm()[1, 0, 0]) == pytest.approx(10.0 + friis_db(d), abs=1e-9)
    assert float(found.best_dbm()[0, 0]) == pytest.approx(20.0 + friis_db(1.0), abs=1e-9)


def test_best_server_is_the_stronger_the_first_of_equals_and_nobody_in_silence():
    found = radio_map(two_transmitters(0.0, 0.0), 2.4e9, **FREE)
    assert found.best_server().tolist() == [[0, 0, 1], [0, 0, 1]]
    loud = radio_map(two_transmitters(0.0, 40.0), 2.4e9, **FREE)
    assert loud.best_server().unique().tolist() == [1]
    nobody = radio_map(Scene(()), 2.4e9, **FREE)
    assert nobody.best_server().unique().tolist() == [-1]
    assert nobody.best_dbm().unique().tolist() == [-math.inf]
    metal = tuple(Node(n.path, Body(n.body.shape, Conductor()), n.pose) for n in room().nodes)
    outside = radio_map(Scene(metal, room().transmitters), 2.4e9, bounds=(7.0, 0.0, 9.0, 2.0),
                        quality=QUALITY, cell=1.0, method="paths")  # fmt: skip
    assert outside.best_server().unique().tolist() == [-1]
    assert outside.coverage(-300.0) == 0.0


def test_sinr_of_two_equal_transmitters_is_0_db_less_the_noise():
    """S / (S + N), N = k T B F."""
    found = radio_map(two_transmitters(0.0, 0.0), 2.4e9, **FREE)
    middle = found.sinr_db(20e6, 7.0)[:, :, 1]
    signal = friis_db(math.hypot(2.0, 1.0))
    noise = thermal_noise_dbm(20e6, 7.0)
    expected = -10 * math.log10(1.0 + 10 ** ((noise - signal) / 10))
    assert middle.flatten().tolist() == pytest.approx([expected] * 4, abs=1e-9)
    assert -1e-3 < expected < 0.0
    snr = found.snr_db(20e6, 7.0)[:, :, 1]
    assert snr.flatten().tolist() == pytest.approx([signal - noise] * 4, abs=1e-9)


def test_alone_sinr_is_snr():
    alone = Scene((), two_transmitters(3.0, 0.0).transmitters[:1], ())
    found = radio_map(alone, 2.4e9, **FREE)
    assert torch.allclose(found.sinr_db(1e6), found.snr_db(1e6), rtol=0, atol=1e-9)


def test_coverage_is_a_share_of_the_area():
    """The lower half of a rectangle is one large triangle and many small ones."""
    found = radio_map(two_transmitters(0.0, 0.0), 2.4e9, **FREE)
    best = found.best_dbm().flatten().sort().values
    assert found.coverage(float(best[0])) == 1.0 and found.coverage(float(best[-1]) + 1.0) == 0.0
    level = 0.5 * float(best[1] + best[2])
    assert found.coverage(level) == pytest.approx(float((best >= level).double().mean()))
    corners = [[0.0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0], [0, 0, 9], [1, 0, 9], [0, 1, 9]]
    mesh = (corners, [[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    on = radio_map_on(two_transmitters(0.0, 0.0), mesh, 2.4e9, cell=6.0, offset=0.0)
    assert on.cells.area.tolist() == pytest.approx([6.0, 6.0, 0.5])
    near = float(on.best_dbm()[:2].min())
    assert on.coverage(near) == pytest.approx(12.0 / 12.5)


# planes


def test_a_tilted_map_is_the_level_map_of_the_turned_scene():
    scene = room()
    tilt = plane_through((0.4, 0.3, 0.2), (1.0, 0.2, 0.3), (-0.1, 1.0, 0.6))
    options = dict(cell=1.5, bounds=(0.3, 0.2, 4.8, 3.2), quality=Quality(depth=1))
    tilted = radio_map(scene, 2.4e9, plane=tilt, method="paths", **options)
    inverse = Pose(tilt.rotation.T, -tilt.rotation.T @ tilt.translation, tilt.scale)
    nodes = tuple(Node(n.path, n.body, inverse.compose(n.pose)) for n in scene.nodes)
    tx = scene.transmitters[0]
    turned = Radio(tx.path, inverse.point_world(tx.position), inverse.rotation @ tx.rotation,
                   tx.velocity)  # fmt: skip
    level = radio_map(Scene(nodes, (turned,)), 2.4e9, height=0.0, method="paths", **options)
    assert torch.allclose(tilted.path_gain, level.path_gain, rtol=1e-9, atol=1e-18)
    assert float(tilted.path_gain.min()) > 0.0
    steep = tilted.cells.point
    assert torch.allclose((steep - tilt.translation) @ tilt.rotation[:, 2], torch.zeros(6).double())


def test_an_upright_map_by_rays_agrees_with_paths_within_its_error():
    scene = room()
    upright = plane_through((0.5, 2.6, 0.0), (1.0, 0.1, 0.0), (0.0, 0.0, 1.0))
    options = dict(plane=upright, cell=1.0, bounds=(0.0, 0.0, 5.0, 3.0), quality=FEWER)
    rays = radio_map(scene, 2.4e9, **options)
    paths = radio_map(scene, 2.4e9, method="paths", **options)
    difference = (10 * torch.log10(rays.path_gain / paths.path_gain)).abs()
    assert float((difference <= 2 * rays.error_db).double().mean()) >= 0.95
    assert float(rays.error_db.median()) < 2.0


def test_without_bounds_a_plane_takes_the_extent_in_its_own_frame():
    wall = plane_through((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    grid = radio_map(room(), 2.4e9, plane=wall, cell=0.5, quality=Quality(depth=0),
                     method="paths").cells  # fmt: skip
    assert grid.shape == (7, 9)  # y from -0.1 to 4.1, z from -0.2 to 3.2
    assert (float(grid.x[0]), float(grid.y[0])) == pytest.approx((0.05, 0.05))


def test_receivers_in_portions_give_the_same_map(monkeypatch):
    options = dict(cell=2.0, bounds=BOUNDS, quality=Quality(depth=1), method="paths")
    whole = radio_map(room(), 2.4e9, **options)
    monkeypatch.setattr("rfsg.tracer.radiomap.RECEIVERS_AT_ONCE", 4)
    parts = radio_map(room(), 2.4e9, **options)
    assert torch.allclose(whole.path_gain, parts.path_gain, rtol=1e-12, atol=0)
    assert parts.modelled and parts.left_out


# surfaces


def test_patches_of_a_box_are_its_faces_just_outside():
    node = box_node("/box", (1.0, 2.0, 0.5), (0.5, 0.3, 0.2), yaw_deg=30.0)
    patches = patches_of(World(Scene((node,))), "/box", 0.3, 0.01)
    assert float(patches.area.sum()) == pytest.approx(8 * (0.15 + 0.1 + 0.06), rel=1e-12)
    side = (patches.triangle.roll(-1, 1) - patches.triangle).norm(dim=-1)
    assert float(side.max()) <= 0.15 + 1e-9  # four triangles to a cell
    assert torch.bincount(patches.owner).unique().tolist() == [4]
    middle = patches.triangle.reshape(-1, 12, 3).mean(1)
    assert torch.allclose(middle, patches.point)
    inner = node.pose.point_object(patches.point)
    beyond = inner.abs() - node.body.shape.half_size
    assert torch.allclose(beyond.amax(-1), torch.tensor(0.01).double(), atol=1e-12)
    assert bool(((inner * node.pose.direction_object(patches.normal)).sum(-1) > 0).all())


@pytest.mark.parametrize(
    ("shape", "area"),
    [(Sphere(0.4), 4 * math.pi * 0.16), (Cylinder(0.2, 0.5), 2 * math.pi * 0.2 * (0.2 + 1.0))],
)
def test_patches_of_a_curved_object_stand_off_the_true_surface(shape, area):
    mirrored = Pose(torch.diag(vector(1.0, -1.0, 1.0)), vector(1.0, 2.0, 3.0), vector(2.0)[0])
    scene = Scene((Node("/thing", Body(shape, Conductor()), mirrored),))
    world = World(scene)
    patches = patches_of(world, "/thing", 0.3, 0.05)
    which = torch.zeros(len(patches.point), dtype=torch.int64)
    assert torch.allclose(world.sdf(which, patches.point), torch.tensor(0.05).double(), atol=1e-6)
    # lifted faces are those of the surface; chords lose a little of it
    assert float(patches.area.sum()) == pytest.approx(4.0 * area, rel=0.05)
    away = patches.triangle.mean(1) - patches.point[patches.owner]
    assert float(away.norm(dim=-1).max()) < 0.3 * 3**0.5 + 0.1  # a cell lies in one cube
    across = (away * patches.normal[patches.owner]).sum(-1).abs()
    assert float(across.max()) < 0.3
    assert bool((torch.bincount(patches.owner) > 0).all())


def test_patches_move_with_their_object():
    """Rigid motion: the same cells, elsewhere."""
    pose = Pose(plane_through((7.0, 8.0, 9.0), (1.0, 0.2, 0.3), (0.0, 1.0, 0.6)).rotation,
                vector(7.0, 8.0, 9.0), vector(1.0)[0])  # fmt: skip
    for shape in (Sphere(0.4), Cylinder(0.2, 0.5), room().nodes[0].body.shape):
        here, there = (
            patches_of(World(Scene((Node("/a", Body(shape, Conductor()), p),))), "/a", 0.5, 0.02)
            for p in (Pose.identity(), pose)
        )
        assert torch.equal(here.owner, there.owner)
        assert torch.allclose(pose.point_world(here.triangle), there.triangle, atol=1e-12)
        assert torch.allclose(pose.point_world(here.point), there.point, atol=1e-9)


def test_a_map_on_an_object_is_a_simulation_at_its_points():
    scene = room()
    scene = Scene((*scene.nodes, box_node("/desk", (3.0, 1.0, 0.6), (0.6, 0.4, 0.02))),
                  scene.transmitters)  # fmt: skip
    quality = Quality(depth=1)
    found = radio_map_on(scene, "/desk", 2.4e9, cell=1.0, quality=quality)
    places = [radio(f"/p{k}", *p.tolist()) for k, p in enumerate(found.cells.point)]
    result = simulate(scene.with_receivers(places), 2.4e9, quality)
    expected = power(result.channel, 1, len(places))[..., 0]
    assert torch.allclose(found.path_gain, expected, rtol=1e-12, atol=0)
    assert float(found.path_gain.min()) > 0.0 and found.method == "paths"
    top = found.cells.normal[:, 2] > 0.9
    bottom = found.cells.normal[:, 2] < -0.9
    # the transmitter is above: the table's top hears more than its underside
    assert float(found.rss_dbm()[0, top].mean()) > float(found.rss_dbm()[0, bottom].mean()) + 3.0


def test_a_map_on_a_mesh_by_rays_agrees_with_paths_within_its_error():
    scene = room()
    corners = [[1.0, 0.5, 0.3], [5.0, 0.5, 0.3], [5.0, 3.0, 1.5], [1.0, 3.0, 1.5], [3.0, 3.5, 2.5]]
    mesh = (corners, [[0, 1, 2], [0, 2, 3], [3, 2, 4]])
    options = dict(cell=1.5, offset=0.0, quality=FEWER)
    rays = radio_map_on(scene, mesh, 2.4e9, method="rays", **options)
    paths = radio_map_on(scene, mesh, 2.4e9, **options)
    difference = (10 * torch.log10(rays.path_gain / paths.path_gain)).abs()
    assert len(difference[0]) > 20
    assert float((difference <= 2 * rays.error_db).double().mean()) >= 0.95
    assert float(rays.error_db.median()) < 2.0


def test_every_ray_is_counted_once_on_a_closed_surface():
    """An isotropic source inside: what the patches collect is all that it sends."""
    node = box_node("/box", (0.2, 0.1, 0.3), (1.0, 0.8, 0.6))
    patches = patches_of(World(Scene((node,))), "/box", 1.0, 0.0)
    mesh = (patches.triangle.reshape(-1, 3), torch.arange(3 * len(patches.owner)).reshape(-1, 3))
    alone = Scene((), (radio("/tx", 0.0, 0.0, 0.0),))
    cells = patches_from(*mesh, 0.5, 0.0)
    found = radio_map_on(alone, mesh, 2.4e9, cell=0.5, offset=0.0, quality=FEWER, method="rays")
    towards = torch.nn.functional.normalize(cells.point, dim=-1)
    flux = (found.path_gain[0] * cells.area * (towards * cells.normal).sum(-1)).sum()
    aperture = (299_792_458.0 / 2.4e9) ** 2 / (4 * math.pi)
    # each patch's own mean cosine is not quite that of its middle
    assert float(flux) / aperture == pytest.approx(1.0, rel=0.02)


def test_it_is_dark_inside_metal_and_lit_before_it():
    """A map by rays through a metal box: nothing within, as by paths."""
    metal = box_node("/box", (3.0, 2.0, 1.2), (0.9, 0.9, 0.5), Conductor())
    scene = Scene((metal,), (radio("/tx", 0.5, 2.0, 2.2),))
    options = dict(cell=1.0, bounds=(1.5, 1.5, 3.5, 2.5), quality=FEWER)
    rays, paths = (radio_map(scene, 2.4e9, method=m, **options) for m in ("rays", "paths"))
    assert rays.path_gain[0, 0, 1] == paths.path_gain[0, 0, 1] == 0.0
    assert bool((rays.path_gain[0, :, 0] > 0).all())


def test_empty_and_wrong_questions():
    alone = Scene((), room().transmitters, ())
    gain = radio_map(alone, 2.4e9, bounds=BOUNDS, quality=QUALITY, cell=2.0).path_gain
    assert bool((gain > 0).all())
    with pytest.raises(SceneError, match="extent"):
        radio_map(Scene(()), 2.4e9)
    with pytest.raises(SceneError, match="method"):
        radio_map(alone, 2.4e9, method="magic")
    for wrong in (
        dict(cell=1e-4),
        dict(cell=5e-324),
        dict(cell=math.nan),
        dict(bounds=(0, 0, 0, 1)),
    ):
        with pytest.raises(SceneError, match="cells"):
            radio_map(alone, 2.4e9, **{"bounds": BOUNDS, **wrong})
    with pytest.raises(SceneError, match="scale"):
        grid_on(Pose.at(0, 0, 0, scale=2.0), BOUNDS, 1.0)
    for u, v in (((1, 0, 0), (2, 0, 0)), ((0, 0, 0), (0, 1, 0)), ((1, 0), (0, 1, 0))):
        with pytest.raises(SceneError, match="plane"):
            plane_through((0, 0, 0), u, v)
    with pytest.raises(ValueError, match="branching"):
        estimate_power(alone.with_receivers(room().receivers), 2.4e9, QUALITY, branching="both")


def test_wrong_surfaces_are_refused():
    ground = Scene((Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity()),))
    with pytest.raises(SceneError, match="/ground: no surface to map"):
        radio_map_on(ground, "/ground", 2.4e9)
    with pytest.raises(SceneError, match="/nothing"):
        radio_map_on(ground, "/nothing", 2.4e9)
    square = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]
    for vertices, faces in (
        ([[0.0, 0]], [[0, 1, 2]]),
        ([[math.nan, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]]),
        (square, [[0, 1, 3]]),
        (square, [[0, 1, -1]]),
        (square, [[0.0, 1.0, 2.0]]),
        (square, []),
        (square, [[0, 1, 1]]),
    ):
        with pytest.raises(SceneError, match="mesh"):
            patches_from(vertices, faces, 0.5, 0.0)
    with pytest.raises(SceneError, match="more than"):
        patches_from([[0.0, 0, 0], [1e4, 0, 0], [0, 1e4, 0]], [[0, 1, 2]], 1e-2, 0.0)
    with pytest.raises(SceneError, match="more than"):  # a sliver: no area, and no end of cells
        patches_from([[0.0, 0, 0], [1e9, 0, 0], [0, 1e-9, 0]], [[0, 1, 2]], 1e-2, 0.0)
    with pytest.raises(SceneError, match="offset"):
        patches_from(square, [[0, 1, 2]], 0.5, -1.0)
