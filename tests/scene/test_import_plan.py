"""Floor plans: walls, rooms, openings, and every feature at fault by its name."""

import json

import numpy as np
import pytest
import torch

from rfsg.scene.importers import import_scene
from rfsg.scene.importers.floorplan import read_floor_plan
from rfsg.scene.importers.openings import openings_of, panels
from rfsg.scene.scene import Scene, SceneError
from rfsg.tracer.plan import Quality
from rfsg.tracer.simulate import simulate

MATERIALS = {"concrete": {"itu": "concrete"}, "glass": {"itu": "glass"}, "wood": {"itu": "wood"}}
DOOR = {"at": 2.0, "width": 0.9, "height": 2.1}
WINDOW = {
    "at": 1.0,
    "width": 1.2,
    "sill": 0.9,
    "height": 1.2,
    "material": "glass",
    "thickness": 0.01,
}


def plan(tmp_path, *features, **more):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({"materials": MATERIALS, "features": features} | more))
    return path


def wall(**said) -> dict:
    return {"name": "w", "line": [[0, 0], [4, 0]], "height": 2.5, "material": "concrete", **said}


def volume(parts) -> float:
    total = 0.0
    for part in parts:
        a, b, c = part.vertices[part.triangles].transpose(1, 0, 2)
        total += float((a * np.cross(b, c)).sum() / 6)
    return total


def test_a_wall_is_a_box_of_its_thickness(tmp_path):
    read = read_floor_plan(plan(tmp_path, wall(thickness=0.3)))
    (part,) = read.parts
    np.testing.assert_allclose(part.vertices.min(0), [0, -0.15, 0], atol=1e-12)
    np.testing.assert_allclose(part.vertices.max(0), [4, 0.15, 2.5], atol=1e-12)
    assert read.materials[part.material].thickness == pytest.approx(0.3)


def test_openings_take_out_what_they_are(tmp_path):
    """Volumes: the wall less the door, and glass where the window is."""
    parts = read_floor_plan(
        plan(tmp_path, wall(thickness=0.2, openings=[DOOR | {"at": 3.0}, WINDOW]))
    ).parts
    glass = [p for p in parts if p.material.startswith("glass")]
    rest = [p for p in parts if p.material.startswith("concrete")]
    assert volume(glass) == pytest.approx(1.2 * 1.2 * 0.01)
    assert volume(rest) == pytest.approx(0.2 * (4 * 2.5 - 0.9 * 2.1 - 1.2 * 1.2))


def test_geojson_and_plain_json_are_the_same_plan(tmp_path):
    plain = read_floor_plan(plan(tmp_path, wall()))
    said = {k: v for k, v in wall().items() if k != "line"}
    feature = {
        "type": "Feature",
        "properties": said,
        "geometry": {"type": "LineString", "coordinates": [[0, 0], [4, 0]]},
    }
    geo = read_floor_plan(plan(tmp_path, feature, type="FeatureCollection"))
    np.testing.assert_array_equal(plain.parts[0].vertices, geo.parts[0].vertices)
    assert plain.materials == geo.materials


def test_rooms_have_walls_floors_and_ceilings(tmp_path):
    ring = [[0, 0], [5, 0], [5, 4], [0, 4], [0, 0]]
    both = {"polygon": ring, "height": 3.0, "thickness": 0.2, "material": "concrete"}
    features = ({"name": "room", **both}, {"name": "under", "kind": "floor", **both},
                {"name": "over", "kind": "ceiling", **both})  # fmt: skip
    read = read_floor_plan(plan(tmp_path, *features))
    names = [p.name for p in read.parts]
    assert names == ["room_0", "room_1", "room_2", "room_3", "under", "over"]
    assert read.parts[4].vertices[:, 2].max() == 0.0 and read.parts[5].vertices[:, 2].min() == 3.0
    assert volume(read.parts[4:5]) == pytest.approx(5 * 4 * 0.2)


def test_a_door_lets_a_wave_through_and_a_wall_weakens_it(tmp_path):
    """Through the open door the free-space gain; through the wall beside it less."""
    source = plan(tmp_path, wall(thickness=0.2, openings=[DOOR]))
    out = tmp_path / "plan.usda"
    import_scene(source, out, tx=[(2.0, -2.0, 1.0)], rx=[(2.0, 2.0, 1.0), (0.5, 2.0, 1.0)])
    result = simulate(Scene.from_usd(out), 2.4e9, quality=Quality(depth=0))
    free = (299792458.0 / 2.4e9 / (4 * np.pi * result.paths.length)) ** 2
    share = result.channel.gain[:, 0].abs() ** 2 / free
    torch.testing.assert_close(share[0], torch.ones((), dtype=torch.float64))
    assert 0.0 < float(share[1]) < 0.3


def test_panels_fill_the_wall_but_for_its_openings():
    """Areas, whatever the openings: random ones that do not overlap."""
    random = np.random.default_rng(1)
    for _ in range(50):
        cuts = np.sort(random.uniform(0, 10, 6)).reshape(3, 2)
        sills, heights = random.uniform(0, 1, 3), random.uniform(0.1, 2, 3)
        said = [
            {"at": (a + b) / 2, "width": b - a, "sill": sill, "height": height}
            for (a, b), sill, height in zip(cuts, sills, heights, strict=True)
            if b - a > 1e-3
        ]
        found = panels(10.0, 3.0, openings_of(said, 1))
        area = sum((p.end - p.start) * (p.high - p.low) for p in found)
        assert area == pytest.approx(30.0)
        holes = sum((p.end - p.start) * (p.high - p.low) for p in found if p.opening)
        assert holes == pytest.approx(sum(o["width"] * o["height"] for o in said))


@pytest.mark.parametrize(
    ("feature", "message"),
    [
        (wall(material="cheese"), "w: material is 'cheese'; expected one of concrete, glass, wood"),
        (wall(thickness=-1), "w: thickness is -1; expected a number of at least"),
        (wall(height="high"), "w: height is 'high'"),
        (wall(line=[[0, 0]]), "w: 1 points; expected 2"),
        (wall(line=[[0, 0], [0, 0]]), "w: piece 0 from .* is 0 m long"),
        (wall(line=[[0, 0], [1e7, 0]]), "w: coordinates beyond"),
        (wall(line="long"), "w: coordinates that are no list"),
        (wall(kind="tent"), "w: kind is 'tent'; expected one of wall, room"),
        (wall(kind="floor"), "w: a floor needs a polygon"),
        (wall(openings=[{"at": 3.9}]), "an opening from 3.45 to 4.35 m"),
        (wall(openings=[{"at": 2}, {"at": 2.1}]), "two openings overlap at"),
        (wall(openings=[{"at": 2, "piece": 3}]), "opening 0: piece is 3; the wall has pieces 0 to 0"),
        (wall(openings=[{"width": 2}]), "opening 0: says no at"),
        (wall(openings=[{"at": 2, "hight": 2}]), "'hight' is unknown"),
        (wall(openings=[DOOR | {"material": "cheese"}]), "an opening of 'cheese'"),
        ({"name": "p", "geometry": {"type": "Point", "coordinates": [0, 0]}}, "p: geometry 'Point'"),
        (7, "feature_1: 7; expected an object"),
    ],
)  # fmt: skip
def test_faults_name_their_feature(tmp_path, feature, message):
    with pytest.raises(SceneError, match=message) as error:
        read_floor_plan(plan(tmp_path, wall(name="fine"), feature))
    assert not any("fine" in fault for fault in error.value.faults)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "a list at the top"),
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ('{"materials": {"a": {"itu": "wood"}}}', "no features"),
        ('{"features": [1]}', "no materials"),
        ('{"materials": {"a": 7}, "features": [1]}', "materials.a"),
    ],
)
def test_what_is_no_plan_is_refused(tmp_path, text, message):
    path = tmp_path / "plan.geojson"
    path.write_text(text)
    with pytest.raises(SceneError, match=message):
        read_floor_plan(path)
