"""Where prims stand and how fast they move, in the world: metres, z up."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from pxr import Usd, UsdGeom

from rfsg.scene.fields import VELOCITY
from rfsg.scene.scene import SceneError
from rfsg.scene.transforms import Placement, broken, decompose
from rfsg.scene.usd.attributes import values_of


def world_from_stage(stage: Usd.Stage, path: Path, faults: list[str]) -> np.ndarray:
    """The matrix that takes the stage to metres, z up; what is amiss joins the faults."""
    world = np.eye(4)
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        faults.append(f"{path}: metersPerUnit is missing; say 1 for metres, 0.01 for cm")
    elif not (np.isfinite(unit) and unit > 0):
        faults.append(f"{path}: metersPerUnit is {unit}; expected a number > 0")
    else:
        world[:3, :3] *= unit
    up = stage.GetMetadata("upAxis")  # USD's own fallback is Y
    if up == "Y":
        world[:3, :3] = world[:3, :3] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    elif up != "Z":
        faults.append(f"{path}: upAxis is {up!r}; expected Y or Z")
    return world


@dataclass
class Places:
    """Places and velocities of the prims of a stage at a time code."""

    time: Usd.TimeCode
    world: np.ndarray  # world [m, z up] from stage
    cache: UsdGeom.XformCache = field(init=False)

    def __post_init__(self) -> None:
        self.cache = UsdGeom.XformCache(self.time)

    def matrix(self, prim: Usd.Prim, cache: UsdGeom.XformCache | None = None) -> np.ndarray:
        """World from local, metres, column vectors."""
        return self.world @ np.array((cache or self.cache).GetLocalToWorldTransform(prim)).T

    def placement(self, prim: Usd.Prim) -> Placement:
        culprit = prim
        while reason := broken(self.matrix(culprit)):
            parent = culprit.GetParent()
            if not parent or parent.IsPseudoRoot() or not broken(self.matrix(parent)):
                raise SceneError([f"{culprit.GetPath()}: {reason}"])
            culprit = parent  # what an ancestor broke is told once, there
        try:
            return decompose(self.matrix(prim))
        except ValueError as error:
            raise SceneError([f"{prim.GetPath()}: {error}"]) from error

    def velocity(self, prim: Usd.Prim) -> torch.Tensor:
        """[m/s] in the world: as authored, else from the time samples of its transforms."""
        said = values_of(prim, self.time, VELOCITY)[VELOCITY.name]
        if said is not None:
            turn = self.world[:3, :3] / np.linalg.norm(self.world[:3, 0])
            velocity = turn @ np.array(said)
        else:
            velocity = self._sampled_velocity(prim)
        return torch.from_numpy(velocity.astype(np.float64))

    def _sampled_velocity(self, prim: Usd.Prim) -> np.ndarray:
        times: set[float] = set()
        above = prim
        while above and not above.IsPseudoRoot():
            xform = UsdGeom.Xformable(above)
            if xform and xform.TransformMightBeTimeVarying():
                times.update(xform.GetTimeSamples())
            above = above.GetParent()
        if len(times) < 2:
            return np.zeros(3)
        first, last = min(times), max(times)
        now = first if self.time.IsEarliestTime() else self.time.GetValue()
        if not first <= now <= last:
            return np.zeros(3)  # held before the first and after the last sample
        # linear between samples, so any step gives the slope; at a sample the mean of both sides,
        # at the ends the one side that moves
        step = 0.5 * min(b - a for a, b in zip(sorted(times), sorted(times)[1:], strict=False))
        before, after = max(first, now - step), min(last, now + step)
        places = [self.matrix(prim, UsdGeom.XformCache(t))[:3, 3] for t in (before, after)]
        rate = prim.GetStage().GetTimeCodesPerSecond() / (after - before)
        return (places[1] - places[0]) * rate
