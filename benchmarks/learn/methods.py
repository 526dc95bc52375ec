"""The columns of the tables: a name and how to make the method for a case.

A further method is one more entry of METHODS. Its ``make`` may use what a case says of the data set
and crop (a scene to load), but never ``case.test.rssi``.
"""

import ast
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from learn.cases import Case
from rfsg.learn import baselines
from rfsg.learn.baselines import Method
from rfsg.learn.free_space import FreeSpace
from rfsg.learn.losses import Losses
from rfsg.learn.region_physics import RegionPhysics
from rfsg.learn.regions import Budget
from rfsg.learn.required import Required
from rfsg.learn.residual import Residual

FOLDER = Path(baselines.__file__).parent


@dataclass(frozen=True)
class Entry:
    """``said`` goes on the page, and so does ``budget``, in steps or minutes, where there is one.

    ``version`` tells results of one code and budget from those of another. ``data_set``: the only one
    that the method is for, if there is one.
    """

    make: Callable[[Case], Method]
    version: str
    said: str
    budget: str = ""
    baseline: bool = True
    data_set: str = ""

    def serves(self, case: Case) -> bool:
        return self.data_set in ("", case.data_set)


def version(*names: str, budget: str = "") -> str:
    """A digest of a budget and of the code of some modules, named from the folder of the baselines.

    Readings are always with them.
    """
    digest = hashlib.sha256(budget.encode())
    for name in (*names, "readings"):
        digest.update(code(FOLDER / f"{name}.py").encode())
    return digest.hexdigest()[:12]


def code(path: Path) -> str:
    """A module without its comments, docstrings and layout: what can change a result."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not is_text(line)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def is_text(line: ast.AST) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)


def methods(nerf2_steps: int = 600) -> dict[str, Entry]:
    """Name -> entry, cheap ones first."""
    kriging = version("kriging", "gaussian_process", "log_distance")
    return {
        "log-distance": Entry(
            lambda case: baselines.LogDistance(),
            version("log_distance"),
            "one exponent for the network and an offset per gateway, by least squares",
        ),
        "1-NN": Entry(
            lambda case: baselines.NearestNeighbours((1,)),
            version("nearest"),
            "the reading of the same gateway nearest to the transmitter",
        ),
        "k-NN": Entry(
            lambda case: baselines.NearestNeighbours(),
            version("nearest"),
            "the mean of the k nearest, k of 1 to 20 by leaving one training reading out",
        ),
        "MRI": Entry(
            lambda case: baselines.Mri(),
            version("mri", "nearest", "log_distance"),
            "log-distance, and its residuals at the same gateway by inverse squared distance",
        ),
        "kriging": Entry(
            lambda case: baselines.GatewayKriging(),
            kriging,
            "log-distance, and a Gaussian field per gateway over transmitter positions",
        ),
        "joint kriging": Entry(
            lambda case: baselines.JointKriging(),
            kriging,
            "log-distance, a Gaussian field over transmitter positions that all gateways share, one "
            "over transmitter and gateway positions together, and gateway offsets",
        ),
        "NeRF2": nerf2(nerf2_steps),
        "rfsg free space": Entry(
            lambda case: FreeSpace(),
            version("../free_space", budget=repr(FreeSpace())),
            "direct paths in a scene without objects; one level, the one that most readings share",
            baseline=False,
        ),
        "rfsg + residual": residual(),
        "rfsg regions": regions(),
    }


def residual() -> Entry:
    """On crop S regions below the residual gained nothing over the empty scene."""
    method = Residual(FreeSpace())
    ours = ("free_space", "residual", "levels", "mixture")
    base = ("kriging", "gaussian_process")
    return Entry(
        lambda case: method,
        version(*base, *(f"../{name}" for name in ours), budget=repr(method)),
        "the same; what it leaves as levels of places and a Gaussian field over them that all gateways "
        "share, gateway offsets, and a field over transmitter and gateway positions together",
        baseline=False,
    )


def regions() -> Entry:
    """There is no floor plan: region objects, unless places held out say that none is needed."""
    rich = RegionPhysics(cell_m=6.0, budget=Budget(losses=Losses(noise_db=3.0, law="student")))
    method, how = Required(FreeSpace(), rich), rich.budget
    budget = (
        f"{how.steps} steps of {how.batch} readings, regions of {rich.cell_m:g} m at most, rate "
        f"{how.learning_rate:g}"
    )
    ours = ("required", "free_space", "regions", "region_physics", "training", "losses")
    return Entry(
        lambda case: method,
        version(*(f"../{name}" for name in ours), budget=repr(method)),
        "direct paths through region objects that learn a loss, a level, and an offset per gateway; "
        "the empty scene where a fifth of the training places, held out, does not ask for more",
        budget,
        baseline=False,
    )


def nerf2(steps: int) -> Entry:
    """The budget of a machine without a GPU: narrower networks and fewer rays than the paper's."""
    method = baselines.Nerf2(steps=steps, batch=32, width=64, octaves=4, directions=36, samples=16)
    budget = (
        f"{method.steps} steps of {method.batch} links, width {method.width}, {method.octaves} "
        f"octaves, {method.directions} directions with {method.samples} samples each"
    )
    return Entry(
        lambda case: method,
        version("nerf2", budget=budget),
        "neural fields of attenuation and retransmission along rays from the receiver (released "
        "settings: 30 000 steps of 128, width 256, 10 octaves, 324 directions, 32 samples)",
        budget,
    )
