"""Radio maps by images: the path solver's values, whatever stands in the way."""

import math

import pytest
import torch

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.world import World
from rfsg.tracer.beams import Rows, lit_by
from rfsg.tracer.cells import grid_on, plane_through
from rfsg.tracer.faces import planes_of
from rfsg.tracer.imagemap import power_by_images
from rfsg.tracer.plan import Quality
from rfsg.tracer.radiomap import radio_map, radio_map_on
from rfsg.tracer.sequences import Budget, levels
from tests.scenes import box_node, radio, room

QUALITY = Quality(depth=2, floor_db=-200.0, refraction=False)
PLASTER = DielectricHalfSpace(eps_r=2.9, sigma=0.02)
GROUND = Node("/ground", Body(HalfSpace(), PLASTER), Pose.identity())


def yard(**transmitter) -> Scene:
    """Opaque and penetrable boxes, turned, over the ground; two of them flush."""
    nodes = (
        GROUND,
        box_node("/a", (2.0, 3.0, 1.0), (0.8, 0.5, 1.0), Conductor(), yaw_deg=20.0),
        box_node("/b", (6.0, 1.0, 1.5), (0.5, 1.0, 1.5), PLASTER),
        box_node("/c", (6.0, 3.0, 1.5), (0.5, 1.0, 1.5), PLASTER),
        box_node("/wall", (4.0, 5.5, 1.25), (3.0, 0.1, 1.25), yaw_deg=-10.0),
    )
    return Scene(nodes, (radio("/tx", 3.9, 1.3, 2.2, **transmitter),))


def both(scene: Scene, **options):
    options = {"quality": QUALITY} | options
    return (radio_map(scene, 2.4e9, method=m, **options) for m in ("images", "paths"))


def the_same(images, paths) -> bool:
    assert images.method == "images" and bool((images.error_db == 0).all())
    return torch.allclose(images.path_gain, paths.path_gain, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("polarization", ["none", "V", "+45"])
def test_by_images_is_by_paths_in_a_yard(polarization):
    scene = yard(polarization=polarization, pattern="half_wave_dipole")
    images, paths = both(scene, bounds=(0.0, 0.0, 8.0, 7.0), cell=0.5, height=1.1)
    assert the_same(images, paths)
    share = float((paths.path_gain > 0).double().mean())
    assert 0.5 < share < 1.0  # inside metal it is dark


def test_by_images_is_by_paths_where_everything_lines_up():
    """Cells on seams, in the planes of faces and at the transmitter's own height."""
    scene = Scene(yard().nodes, (radio("/tx", 4.0, 2.0, 1.0),))
    images, paths = both(scene, bounds=(0.25, 0.25, 8.25, 4.25), cell=0.5, height=1.0)
    assert the_same(images, paths)


def test_by_images_is_by_paths_in_a_room_on_a_tilted_plane():
    tilt = plane_through((0.4, 0.3, 0.2), (1.0, 0.2, 0.3), (-0.1, 1.0, 0.6))
    quality = Quality(depth=3, floor_db=-60.0)
    images, paths = both(room(), plane=tilt, cell=1.0, bounds=(0.3, 0.2, 6.8, 4.2), quality=quality)
    assert the_same(images, paths)


def test_by_images_is_by_paths_on_a_surface():
    images, paths = (
        radio_map_on(yard(), "/b", 2.4e9, cell=0.8, quality=QUALITY, method=m)
        for m in ("images", "paths")
    )
    assert the_same(images, paths)


def test_faces_that_coincide_reflect_once():
    twice = (GROUND, *(Node(p, GROUND.body, GROUND.pose) for p in ("/again", "/and-again")))
    scene = Scene(twice, (radio("/tx", 0.0, 0.0, 3.0),))
    images, paths = both(scene, bounds=(1.0, 1.0, 4.0, 3.0), cell=1.0)
    once = radio_map(Scene(twice[:1], scene.transmitters), 2.4e9, method="images",
                     bounds=(1.0, 1.0, 4.0, 3.0), cell=1.0, quality=QUALITY)  # fmt: skip
    assert the_same(images, paths) and torch.equal(images.path_gain, once.path_gain)


def test_over_metal_ground_power_is_that_of_two_rays():
    """1 / d1^2 + 1 / d2^2, times (lambda / 4 pi)^2."""
    metal = Node("/ground", Body(HalfSpace(), Conductor()), Pose.identity())
    scene = Scene((metal,), (radio("/tx", 0.0, 0.0, 3.0),))
    found = radio_map(scene, 2.4e9, method="images", bounds=(5.0, -0.5, 9.0, 0.5), cell=1.0,
                      height=1.0, quality=QUALITY)  # fmt: skip
    wavelength = 299_792_458.0 / 2.4e9
    for k, x in enumerate((5.5, 6.5, 7.5, 8.5)):
        expected = (1 / (x**2 + 4.0) + 1 / (x**2 + 16.0)) * (wavelength / (4 * math.pi)) ** 2
        assert float(found.path_gain[0, 0, k]) == pytest.approx(expected, rel=1e-12)


def test_portions_do_not_change_the_map():
    options = dict(bounds=(0.0, 0.0, 8.0, 7.0), cell=0.7, method="images")
    whole, parts = (
        radio_map(yard(), 2.4e9, quality=Quality(depth=2, refraction=False, chunk=n), **options)
        for n in (65_536, 50)
    )
    assert torch.allclose(whole.path_gain, parts.path_gain, rtol=1e-12, atol=0.0)


def test_rows_are_lit_where_each_point_alone_would_be():
    """Intervals of a row against every point as a row of its own."""
    planes = planes_of(World(yard()))
    grid = grid_on(Pose.at(0, 0, 1.1), (0.0, 0.0, 8.0, 7.0), 0.4)
    alone = Rows(grid.point, torch.zeros(3, dtype=torch.float64), 1)
    assert torch.allclose(
        grid.rows.origin[:, None] + torch.arange(20)[:, None] * grid.rows.step,
        grid.point.reshape(*grid.shape, 3),
    )
    source = yard().transmitters[0].position
    for sequences in levels(planes, source, 2, Budget(10**9)):
        a, b = (
            {(s, p) for lit in lit_by(planes, sequences, rows, 1000)
             for s, p in zip(lit.sequence.tolist(), lit.point.tolist(), strict=True)}
            for rows in (grid.rows, alone)
        )  # fmt: skip
        assert a == b and len(a) > 0


def test_scenes_that_it_does_not_hold_for_are_refused():
    ball = Node("/ball", Body(Sphere(0.4), Conductor()), Pose.at(2.0, 3.0, 1.0))
    scene = Scene((GROUND, ball), yard().transmitters)
    options = dict(bounds=(0.0, 0.0, 8.0, 7.0), cell=1.0, method="images")
    with pytest.raises(SceneError, match="/ball is neither"):
        radio_map(scene, 2.4e9, quality=QUALITY, **options)
    with pytest.raises(SceneError, match="diffuse"):
        radio_map(yard(), 2.4e9, quality=Quality(refraction=False, diffuse=8), **options)
    with pytest.raises(SceneError, match="exact"):
        radio_map(yard(), 2.4e9, quality=QUALITY, budget_s=1.0, **options)
    assert "diffraction" in " ".join(
        radio_map(yard(), 2.4e9, quality=Quality(depth=0, diffraction=1), **options).left_out
    )
    nobody = power_by_images(World(yard()), (), torch.zeros(0, 3).double(), grid_on(
        Pose.at(0, 0, 1.1), (0.0, 0.0, 2.0, 2.0), 1.0).rows, torch.zeros(4, 3).double(),
        torch.tensor([2.4e9]).double(), QUALITY)  # fmt: skip
    assert nobody.shape == (0, 4)
