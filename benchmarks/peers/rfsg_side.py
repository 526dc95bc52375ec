"""rfsg's half: traces the cases and writes what it finds, in the same form as the peer.

python rfsg_side.py --out DIR CASE ...
"""

import argparse
from pathlib import Path

import cases
import numpy as np
import torch
from exchange import DIFFRACT, REFLECT, SCATTER, Traced, file_of

from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, HalfSpace, Sphere
from rfsg.objects.surfaces.interface import Conductor, DielectricHalfSpace
from rfsg.objects.surfaces.slab import Slab
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene
from rfsg.tracer.plan import Quality
from rfsg.tracer.records import Act
from rfsg.tracer.simulate import simulate

TILES = 64  # per face and direction, at least
KINDS = {Act.REFLECT: REFLECT, Act.DIFFRACT: DIFFRACT, Act.SCATTER: SCATTER}


def node(thing: cases.Thing) -> Node:
    perfect = thing.itu == "conductor"
    surface = Conductor() if perfect else DielectricHalfSpace(itu=thing.itu)
    if isinstance(thing, cases.Ground):
        return Node(f"/{thing.name}", Body(HalfSpace(), surface), Pose.identity())
    if isinstance(thing, cases.Ball):
        return Node(f"/{thing.name}", Body(Sphere(thing.radius), surface), Pose.at(*thing.centre))
    low, high = np.array(thing.low), np.array(thing.high)
    if isinstance(thing, cases.Wall):
        rough = {"coefficient": thing.scattering} if thing.scattering else None
        surface = Slab(thing.thickness, itu=thing.itu, scattering=rough)
    return Node(
        f"/{thing.name}",
        Body(Box(((high - low) / 2).tolist()), surface),
        Pose.at(*(low + high) / 2),
    )


def build(case: cases.Case) -> Scene:
    end = case.receiver_polarization or case.polarization
    receivers = tuple(
        Radio.at(f"/rx{r}", *p, polarization=end) for r, p in enumerate(case.receivers)
    )
    scene = Scene(
        tuple(node(t) for t in case.things),
        (Radio.at("/tx", *case.transmitter, polarization=case.polarization),),
        receivers,
        case.frequency,
    )
    return scene if case.move is None else scene.moved(f"/{case.move[0]}", case.move[1])


def trace(case: cases.Case) -> Traced:
    quality = Quality(
        depth=case.depth,
        floor_db=case.floor_db,
        diffraction=int(case.diffraction),
        diffraction_depth=1,
        diffuse=TILES if case.diffuse else 0,
    )
    result = simulate(build(case), quality=quality)
    paths, channel = result.paths, result.channel
    used = paths.which >= 0
    own = torch.tensor([KINDS.get(a, -1) for a in Act])
    return Traced(
        names=np.array([t.name for t in case.things]),
        rx=paths.rx.numpy(),
        kind=torch.where(used, own[paths.act], -1).numpy(),
        item=paths.which.numpy(),
        vertex=torch.where(used[..., None], paths.vertices[:, 1:-1], torch.nan).numpy(),
        crossed=torch.bincount(channel.crossed[:, 0], minlength=len(paths.tx)).numpy(),
        delay=channel.delay.numpy(),
        gain=channel.gain[:, 0].numpy(),
        departure=channel.departure.numpy(),
        arrival=channel.arrival.numpy(),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    for name in options.cases:
        trace(cases.named(name)).save(file_of(options.out, name, "rfsg"))


if __name__ == "__main__":
    main()
