"""Closed meshes in USD files: polygons, units, stretches, other programs' edits, faults."""

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.solid import Solid
from rfsg.scene import usd
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from tests.laws.catalogue import angle_iron
from tests.scene.scene_text import known

F64 = torch.float64
POINTS = "point3f[] points = [" + ", ".join(
    str((float(x), float(y), float(z))) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
) + "]"  # fmt: skip
QUADS = [[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]


def drawn(points: str = POINTS, faces=QUADS, extra: str = "", order: str = "") -> str:
    count, index = [len(f) for f in faces], [i for f in faces for i in f]
    return known(
        "Mesh",
        f"""{points}
        int[] faceVertexCounts = {count}
        int[] faceVertexIndices = {index}
        uniform token subdivisionScheme = "none"
        {extra}""",
        order,
    )


def cloud(count: int = 500) -> torch.Tensor:
    return 4.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=F64) - 2.0


def test_a_mesh_is_a_solid_of_its_faces_in_metres(scene_file):
    """Stretched unevenly, in centimetres: the sizes go into the shape, the frame stays rigid."""
    stretch = dict(
        extra="double3 xformOp:scale = (10, 20, 30)\n        double3 xformOp:translate = (5, 0, 0)",
        order='"xformOp:translate", "xformOp:scale"',
    )
    node = Scene.from_usd(scene_file(drawn(**stretch), metre=0.01)).node("/World/Thing")
    assert node.body.shape.kind == "mesh" and len(node.body.shape.planes()) == 6
    torch.testing.assert_close(
        node.body.shape.sdf(cloud()), Box([0.1, 0.2, 0.3]).sdf(cloud()), rtol=0, atol=1e-15
    )
    torch.testing.assert_close(node.pose.translation, torch.tensor([0.05, 0.0, 0.0], dtype=F64))
    assert float(node.pose.scale) == 1.0


def test_mirrored_and_left_handed_meshes_look_outward(scene_file):
    mirror = dict(extra="double3 xformOp:scale = (-1, 1, 1)", order='"xformOp:scale"')
    left = dict(extra='uniform token orientation = "leftHanded"', faces=[f[::-1] for f in QUADS])
    for options in (mirror, left, dict(faces=[f[::-1] for f in QUADS])):
        shape = Scene.from_usd(scene_file(drawn(**options))).node("/World/Thing").body.shape
        torch.testing.assert_close(
            shape.sdf(cloud()), Box([1.0] * 3).sdf(cloud()), rtol=0, atol=1e-15
        )


def written(tmp_path, name: str = "scene.usda"):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).to(F64))[0]
    shape = Mesh(angle_iron().vertices @ turn / 3.0, angle_iron().triangles)
    nodes = (
        Node("/World/A", Body(shape, Conductor()), Pose.at(1.0, 2.0, 3.0, 25.0)),
        Node("/World/B", Body(angle_iron(), Solid("wood")), Pose(turn, cloud(1)[0], torch.tensor(2.0, dtype=F64))),
    )  # fmt: skip
    scene = Scene(nodes)
    return scene, usd.write(scene, tmp_path / name)


def test_saved_is_loaded_to_the_bit(tmp_path):
    scene, path = written(tmp_path)
    read = Scene.from_usd(path)
    for a, b in zip(read.nodes, scene.nodes, strict=True):
        scale = b.pose.scale / a.pose.scale  # a scale is absorbed by what is read
        torch.testing.assert_close(
            a.body.shape.vertices, b.body.shape.vertices * scale, rtol=1e-15, atol=0
        )
        assert torch.equal(a.body.shape.triangles, b.body.shape.triangles)
        torch.testing.assert_close(a.pose.rotation, b.pose.rotation, rtol=0, atol=1e-12)
    assert torch.equal(read.nodes[0].body.shape.vertices, scene.nodes[0].body.shape.vertices)
    assert usd.check(path) == []


def test_what_another_program_moved_is_where_it_put_it(tmp_path):
    """The double-precision points beside a mesh count only while they are the mesh's."""
    scene, path = written(tmp_path)
    stage = Usd.Stage.Open(str(path))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/A")).GetPointsAttr()
    moved = np.array(points.Get()) * 1.5
    points.Set(moved)
    stage.GetRootLayer().Save()
    del stage
    shape = Scene.from_usd(path).nodes[0].body.shape
    torch.testing.assert_close(
        shape.vertices.detach().numpy().sum(), np.float64(moved.sum()), rtol=1e-6, atol=1e-6
    )
    assert float((shape.bounds()[1] / scene.nodes[0].body.shape.bounds()[1])[0]) == pytest.approx(
        1.5, rel=1e-6
    )


def test_instances_share_one_shape(scene_file):
    body = """
    class "Library"
    {
        def Xform "Crate"
        {""" + drawn().replace('"Thing"', '"Box"') + """        }
    }
    def Xform "One" (
        instanceable = true
        references = </World/Library/Crate>
    )
    {
    }
    def Xform "Two" (
        instanceable = true
        references = </World/Library/Crate>
    )
    {
        double3 xformOp:translate = (9, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
"""  # fmt: skip
    scene = Scene.from_usd(scene_file(body))
    one, two = scene.node("/World/One/Box"), scene.node("/World/Two/Box")
    assert one.body is two.body and float(two.pose.translation[0]) == 9.0


def test_a_cage_to_be_subdivided_is_said(scene_file):
    text = drawn().replace('subdivisionScheme = "none"', 'subdivisionScheme = "catmullClark"')
    (warning,) = [w for w in Scene.from_usd(scene_file(text)).warnings if "subdivided" in w]
    assert "/World/Thing" in warning
    assert not any("subdivided" in w for w in Scene.from_usd(scene_file(drawn())).warnings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (drawn(faces=QUADS[1:]), "/World/Thing: no solid for waves: the mesh is not closed: 4 edges.*learn-shape"),
        (drawn(faces=[]), "a mesh without faces"),
        (drawn(faces=[*QUADS[1:], [3, 2, 1, 8]]), "Indices go from 0 to 8; there are 8 points"),
        (drawn(points=""), "there are 0 points"),
        (drawn(points=POINTS.replace("(-1.0, -1.0, -1.0)", "(nan, 0, 0)")), "not finite"),
        (drawn().replace("faceVertexCounts = [4,", "faceVertexCounts = [5,"), "name 25 corners.*24 of"),
        (drawn().replace("faceVertexCounts = [4, 4,", "faceVertexCounts = [2, 6,"), "at least 2 a face"),
        (drawn(extra="custom double3[] rfsg:mesh:points = [(inf, 0, 0)]"), "rfsg:mesh:points.*triples"),
    ],
)  # fmt: skip
def test_what_is_amiss_is_told_with_its_prim(scene_file, text, message):
    with pytest.raises(SceneError, match=message):
        Scene.from_usd(scene_file(text))


def test_a_mesh_with_a_material_on_a_part_is_refused(scene_file):
    subset = """
        def GeomSubset "Lid" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            uniform token elementType = "face"
            int[] indices = [1]
            rel material:binding = </World/Concrete>
        }
"""
    text = drawn().rstrip().removesuffix("}") + subset + "    }\n"
    with pytest.raises(SceneError, match="/World/Thing/Lid: a radio material on a part.*Divide"):
        Scene.from_usd(scene_file(text))


def test_too_many_triangles_are_refused_before_they_are_made(scene_file, monkeypatch):
    monkeypatch.setattr("rfsg.scene.usd.meshes.MAX_TRIANGLES", 11)
    with pytest.raises(SceneError, match="12 triangles; expected 11 at most"):
        Scene.from_usd(scene_file(drawn()))
