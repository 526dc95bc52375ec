"""The only door to Embree: which triangle does a ray meet first, in float32, and how far away."""

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Float, Int
from torch import Tensor


class Triangles:
    """Triangles [t 3 3] in metres in an Embree scene of their own, built once.

    Embree sees float32: it runs about the middle of the triangles, so that far-off origins cost no
    precision. What must be exact is decided by the caller.
    """

    def __init__(self, corners: Float[Tensor, "t 3 3"]):
        flat = corners.detach().reshape(-1, 3)
        none = flat.new_zeros(3)
        self.middle = 0.5 * (flat.amin(0) + flat.amax(0)) if len(flat) else none
        local = (flat - self.middle).reshape(-1, 3, 3).cpu().numpy()
        self._scene = rtcore_scene.EmbreeScene() if len(flat) else None
        if self._scene is not None:
            TriangleMesh(self._scene, np.ascontiguousarray(local, dtype=np.float32))

    def first(
        self, origin: Float[Tensor, "r 3"], direction: Float[Tensor, "r 3"]
    ) -> tuple[Int[Tensor, "r"], Float[Tensor, "r"]]:
        """The first triangle each ray meets, -1 for none, and the distance to it [m], float64."""
        if self._scene is None or not len(origin):
            none = torch.full((len(origin),), -1, dtype=torch.int64, device=origin.device)
            return none, torch.full_like(origin[:, 0], torch.inf)
        out = self.shot(_float32(origin - self.middle.to(origin)), _float32(direction))
        triangle = torch.from_numpy(out["primID"].astype(np.int64)).to(origin.device)
        missed = torch.from_numpy(out["geomID"].astype(np.int64)).to(origin.device) < 0
        distance = torch.from_numpy(out["tfar"].astype(np.float64)).to(origin.device)
        return torch.where(missed | (triangle < 0), -1, triangle), distance

    def shot(self, origin: np.ndarray, direction: np.ndarray) -> dict[str, np.ndarray]:
        """All that Embree says of rays, float32 [r 3], from origins about ``middle``. There must be
        triangles."""
        assert self._scene is not None
        return self._scene.run(origin, direction, query="INTERSECT", output=True)


def _float32(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().cpu().numpy(), dtype=np.float32)
