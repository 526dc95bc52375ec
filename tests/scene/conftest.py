"""Small scenes and a small asset, written where a test wants them."""

import shutil
from pathlib import Path

import numpy as np
import pytest

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {metre}
    upAxis = "{up}"
)

def Xform "World"
{{
    def Material "Concrete"
    {{
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "concrete"
    }}

    def Material "Metal"
    {{
        custom token rfsg:material:model = "conductor"
    }}

{body}
}}
"""


@pytest.fixture
def scene_file(tmp_path):
    """scene_file(body, metre=1, up="Z", name="scene.usda") writes a scene and returns its path."""

    def write(body: str, metre: object = 1, up: str = "Z", name: str = "scene.usda") -> Path:
        path = tmp_path / name
        path.write_text(HEAD.format(body=body, metre=metre, up=up))
        return path

    return write


@pytest.fixture(scope="session")
def small_asset(tmp_path_factory):
    """An untrained object, 0.6 x 0.4 x 1 m, and the asset that holds it."""
    from rfsg.objects.body import Body
    from rfsg.objects.shapes.neural import NeuralShape
    from rfsg.objects.surfaces.interface import Conductor
    from rfsg.scene.assets import save_asset

    shape = NeuralShape(
        [[-0.3, -0.2, 0.0], [0.3, 0.2, 1.0]],
        width=8, depth=3, skip=1, frequencies=2, features=4, lipschitz=2.0,
    )  # fmt: skip
    body = Body(shape, Conductor())
    vertices = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    path = tmp_path_factory.mktemp("assets") / "cabinet.usda"
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    save_asset(path, body, mesh=(vertices, faces, normals), provenance={"seed": 3})
    return body, path


@pytest.fixture
def asset_here(small_asset, tmp_path):
    """The small asset copied beside the test's scene; returns its USD file."""
    _, path = small_asset
    for suffix in (".usda", ".safetensors"):
        shutil.copy(path.with_suffix(suffix), tmp_path)
    return tmp_path / path.name
