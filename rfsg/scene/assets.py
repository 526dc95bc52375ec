"""One object <-> one reusable asset: NAME.usda beside NAME.safetensors and NAME.png.

The USD file says where the weights are, what they hash to, how they were made and at what frequencies,
and carries the meshes that other programs show; the safetensors file is the object. See ``weights.py``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.objects.body import Body
from rfsg.objects.displayed import Displayed
from rfsg.scene import usd
from rfsg.scene.scene import SceneError

Mesh = tuple[
    Float[ndarray, "v 3"] | Float[Tensor, "v 3"],
    Int[ndarray, "t 3"] | Int[Tensor, "t 3"],
    Float[ndarray, "v 3"] | Float[Tensor, "v 3"],
]


@dataclass(frozen=True)
class LoadedAsset(Displayed):
    """An object read back: ``path`` is the asset's USD file, ``weights`` its tensors' file and
    ``sha256`` that file's, ``prim`` the object's path in the layer. picture: path of its thumbnail, in
    a package PACKAGE[NAME]. extent: what the drawn surface spans [m]. parts: all files of the asset,
    none where they lie in several folders."""

    body: Body
    provenance: dict[str, Any]
    path: Path
    weights: Path
    sha256: str
    prim: str = ""
    picture: str | None = None
    extent: Float[ndarray, "2 3"] | None = None
    parts: tuple[Path, ...] = ()


def save_asset(
    path: str | Path,
    body: Body,
    *,
    name: str | None = None,
    mesh: Mesh | None = None,
    hull: tuple[Float[ndarray, "w 3"], Int[ndarray, "s 3"]] | None = None,
    picture: bytes | None = None,
    provenance: Mapping[str, Any] | None = None,
    color: Sequence[float] = (0.55, 0.57, 0.6),
    overwrite: bool = False,
) -> Path:
    """Write NAME.usda and NAME.safetensors, and NAME.png for a picture; returns the USD file's path.

    path: NAME.usda, or the same without its ending. name: the root prim, by default the file's
    name. mesh: vertices [m], triangles and outward unit vertex normals of the extracted surface, in
    the object's frame, for other programs to show. hull: vertices [m] and triangles of its convex
    hull, a guide. picture: PNG. provenance: anything JSON can hold (source mesh, seed, report). color:
    linear RGB of the mesh. The band that the object was learned at is ``body.band``.

    Raises SceneError when a file is there and ``overwrite`` is False, when the mesh or the
    provenance cannot be written, or the folder does not exist.
    """
    usda = Path(path).with_suffix(".usda")
    usd.write_asset(
        usda,
        body,
        name=name or usda.stem,
        mesh=mesh,
        hull=hull,
        picture=picture,
        provenance=provenance,
        color=color,
        overwrite=overwrite,
    )
    return usda


def load_asset(path: str | Path) -> LoadedAsset:
    """Read an asset's USD file (.usda, .usdz) back: the same bits as were saved.

    Raises SceneError listing every fault; the weights must lie in the asset's folder tree.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        raise SceneError([f"{path}: give the asset's USD file ({path.with_suffix('.usda').name})"])
    found = usd.read_asset(path)
    return LoadedAsset(
        found.body,
        found.provenance,
        path,
        Path(found.weights),
        found.sha256,
        found.prim,
        found.picture,
        found.extent,
        found.parts,
    )
