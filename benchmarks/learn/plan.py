"""A floor plan whose objects learn what they take away: ``FloorPlan``, a method for tetam-ble.

Received power is level + offset of the gateway + 10 log10 of

    free space * pattern of the gateway * product over objects of (1 - p + p t)  +  reverberation.

p = 1 - exp(-d / LENGTH) is the probability that the straight line is intercepted by an object that is
known to BLUR only: d = integral of sigmoid(-f / BLUR) along it, f the object's signed distance
(exponential transport through stochastic geometry: paper/rfsg.md). t, what an intercepted wave keeps,
is learned of every object. Reverberation is one power for the whole room, of all that comes from
everywhere (J. B. Andersen, J. O. Nielsen, G. F. Pedersen, G. Bauch, J. M. Herdin, "Room
electromagnetics", IEEE Antennas and Propagation Magazine 49 (2), 2007). The pattern is of the first
order [dB], a . u with u the direction of the line: what hangs on a wall hears one side better.

Which terms there are, BLUR, LENGTH and the prior of the pattern were chosen on set_1 alone
(benchmarks/floor_plan.py). ``rays`` adds traced mirrors and edges.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import softplus

from learn.methods import Entry, code, version
from rfsg.learn.baselines import Method, Prediction, Readings
from rfsg.learn.baselines.readings import check_links, distance
from rfsg.learn.losses import huber
from rfsg.learn.regions import friis_db
from rfsg.learn.required import Required
from rfsg.learn.residual import Residual
from rfsg.scene.scene import Node, Scene

SCENE = Path(__file__).resolve().parents[2] / "assets" / "scenes" / "tetam_lab.usda"

BLUR, LENGTH = 0.05, 0.1  # [m]
# A line is cut in PIECES with so many SAMPLES each (midpoint rule): every 0.13 m on the longest.
PIECES, SAMPLES = 10, 20
FAR = 10.0  # blurs outside, an object takes 5e-5 of what it takes inside

# Beyond KNEE of these a reading counts linearly only (Huber): what the model leaves, about.
NOISE_DB = 4.0

# Prior means and standard deviations [dB]. Of an object: its kind (the prim that it stands in), and
# how it differs from its kind. Reverberation: as strong as free space at 10 m, within a factor of 6.
OFFSET_STD = 4.0
LOSS, LOSS_STD, OWN_STD = 10.0, 8.0, 2.0
REVERBERANT_M, REVERBERANT_STD = 10.0, 8.0
RAYS_STD = 4.0

# Powers [linear] of further paths of each link, in so many kinds, from both positions.
Rays = Callable[[Float[ndarray, "n 3"], Float[ndarray, "n 3"]], Float[ndarray, "n c"]]


@dataclass(frozen=True)
class FloorPlan:
    """Settings: the scene, and which terms there are.

    ``pattern_db``: prior standard deviation of each component of a gateway's pattern, 0 for none.
    """

    scene: Scene = field(repr=False)
    objects: bool = True
    reverberant: bool = True
    pattern_db: float = 2.0
    own_db: float = OWN_STD
    blur_m: float = BLUR
    length_m: float = LENGTH
    frequency_hz: float = 2.44e9
    rays: Rays | None = field(default=None, repr=False)

    def fit(self, readings: Readings, seed: int = 0) -> "Plan":
        """Maximum a posteriori, by L-BFGS from the prior means. Nothing is random."""
        heard, gateway = np.unique(readings.gateway, return_inverse=True)
        lines = self.lines(readings.tx_position, readings.rx_position)
        priors = self.priors(len(heard), lines)
        value = {name: p.mean.clone().requires_grad_() for name, p in priors.items()}
        of, measured = torch.as_tensor(gateway.ravel()), torch.as_tensor(readings.rssi)
        with torch.no_grad():
            value["level"] += (measured - received_db(value, lines, of)).median()
        climb = torch.optim.LBFGS(list(value.values()), max_iter=300, line_search_fn="strong_wolfe")

        def cost() -> Tensor:
            climb.zero_grad()
            off = (measured - received_db(value, lines, of)) / NOISE_DB
            total = huber(off**2).sum()
            for name, prior in priors.items():
                if name != "level":  # anything goes: nobody knows what the beacon sends
                    total = total + 0.5 * (((value[name] - prior.mean) / prior.std) ** 2).sum()
            total.backward()
            return total

        climb.step(cost)
        found = {name: v.detach() for name, v in value.items()}
        rest = measured - received_db(found, lines, of)
        told = 1 + 4 * len(heard)  # level, offsets and patterns; the rest is little beside
        std = float((rest**2).sum().div(max(len(rest) - told, len(rest) // 2, 1)).sqrt())
        return Plan(self, heard, found, std)

    def priors(self, gateways: int, lines: "Lines") -> dict[str, "Prior"]:
        """Of everything that is learned, by name [dB]."""
        at = torch.full((1,), REVERBERANT_M, dtype=torch.float64)
        room = float(friis_db(at, torch.full_like(at, self.frequency_hz)))
        priors = {"level": Prior.of((), 0.0, 1.0), "offset": Prior.of((gateways,), 0.0, OFFSET_STD)}
        if self.objects:
            count = len(torch.unique(lines.kind))
            priors["kind"] = Prior.of((count,), LOSS, LOSS_STD)
            priors["own"] = Prior.of((len(lines.kind),), 0.0, self.own_db)
        if self.pattern_db > 0:
            priors["pattern"] = Prior.of((gateways, 3), 0.0, self.pattern_db)
        if self.reverberant:
            priors["reverberant"] = Prior.of((), room, REVERBERANT_STD)
        if self.rays is not None:
            priors["rays"] = Prior.of((lines.rays.shape[1],), 0.0, RAYS_STD)
        return priors

    def lines(
        self, tx_position: Float[ndarray, "n 3"], rx_position: Float[ndarray, "n 3"]
    ) -> "Lines":
        """What is known of straight lines from receivers to transmitters [m]."""
        begin, end = torch.as_tensor(rx_position), torch.as_tensor(tx_position)
        apart = torch.as_tensor(distance(tx_position, rx_position))
        inside = torch.zeros(len(apart), len(self.scene.nodes), dtype=torch.float64)
        for k, node in enumerate(self.scene.nodes):
            inside[:, k] = depth(node, begin, end, self.blur_m)
        none = np.zeros((len(apart), 0))
        return Lines(
            friis_db(apart, torch.full_like(apart, self.frequency_hz)),
            (end - begin) / apart[:, None],
            -torch.expm1(-inside / self.length_m),
            kinds(self.scene),
            torch.as_tensor(none if self.rays is None else self.rays(tx_position, rx_position)),
        )


def kinds(scene: Scene) -> Int[Tensor, "o"]:
    """The number of the prim that each object stands in: objects of one prim are of one kind."""
    parents = [node.path.rsplit("/", 1)[0] for node in scene.nodes]
    return torch.tensor([sorted(set(parents)).index(p) for p in parents], dtype=torch.int64)


@dataclass(frozen=True)
class Prior:
    mean: Float[Tensor, "*s"]
    std: float

    @staticmethod
    def of(shape: tuple[int, ...], mean: float, std: float) -> "Prior":
        return Prior(torch.full(shape, mean, dtype=torch.float64), std)


@dataclass(frozen=True)
class Lines:
    """n lines: path gain of free space [dB], unit vector from the receiver, probability that each of
    the o objects intercepts, the kind of each object, and powers of further paths."""

    free_db: Float[Tensor, "n"]
    direction: Float[Tensor, "n 3"]
    intercepted: Float[Tensor, "n o"]
    kind: Int[Tensor, "o"]
    rays: Float[Tensor, "n c"]


@dataclass(frozen=True)
class Plan:
    """A fitted floor plan: ``value`` by name as in ``FloorPlan.priors``, ``std`` [dB] of what is left."""

    how: FloorPlan
    gateways: Int[ndarray, "g"]
    value: dict[str, Tensor]
    std: float

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] and standard deviation [dB]; a gateway never heard has no offset or pattern.

        Raises ValueError when lengths differ or a position is not finite.
        """
        check_links(tx_position, rx_position, gateway)
        of = np.searchsorted(self.gateways, gateway)
        of[~np.isin(gateway, self.gateways)] = len(self.gateways)
        value = self.value | {
            name: padded(self.value[name]) for name in PER_GATEWAY & set(self.value)
        }
        lines = self.how.lines(tx_position, rx_position)
        mean = received_db(value, lines, torch.as_tensor(of)).numpy()
        return Prediction(mean, np.full(len(mean), self.std))

    def losses_db(self) -> dict[str, float]:
        """What an intercepted wave loses [dB], by prim path."""
        names = [node.path for node in self.how.scene.nodes]
        found = loss_db(self.value, kinds(self.how.scene))
        return dict(zip(names, found.tolist(), strict=True))


PER_GATEWAY = {"offset", "pattern"}


def padded(value: Float[Tensor, "g *s"]) -> Float[Tensor, "h *s"]:
    """A row of zeros more: that of a gateway never heard."""
    return torch.cat([value, torch.zeros_like(value[:1])])


def received_db(
    value: dict[str, Tensor], lines: Lines, gateway: Int[Tensor, "n"]
) -> Float[Tensor, "n"]:
    """Received power [dBm] with what is learned as it is now; differentiable."""
    direct = lines.free_db
    if "pattern" in value:
        direct = direct + (value["pattern"][gateway] * lines.direction).sum(-1)
    power = 10.0 ** (direct / 10.0)
    if "kind" in value:
        kept = 10.0 ** (-loss_db(value, lines.kind) / 10.0)
        power = power * (1.0 - lines.intercepted * (1.0 - kept)).prod(-1)
    if "rays" in value:
        power = power + lines.rays @ 10.0 ** (value["rays"] / 10.0)
    if "reverberant" in value:
        power = power + 10.0 ** (value["reverberant"] / 10.0)
    return value["level"] + value["offset"][gateway] + 10.0 * torch.log10(power)


def loss_db(value: dict[str, Tensor], kind: Int[Tensor, "o"]) -> Float[Tensor, "o"]:
    """What an intercepted wave loses in each object [dB], never below 0."""
    return softplus(value["kind"][kind] + value["own"])


@torch.no_grad()
def depth(
    node: Node, begin: Float[Tensor, "n 3"], end: Float[Tensor, "n 3"], blur: float
) -> Float[Tensor, "n"]:
    """How far lines run in a blurred object [m]: the integral of sigmoid(-f / blur)."""
    shape, pose = node.body.shape, node.pose
    begin, end = ((p - pose.translation) @ pose.rotation for p in (begin, end))
    step = (end - begin) / PIECES
    piece = torch.arange(PIECES, dtype=torch.float64)[:, None] + 0.5
    middle = begin[:, None] + step[:, None] * piece
    length = step.norm(dim=-1, keepdim=True).expand(-1, PIECES)
    # f cannot fall faster than its slope: most pieces are too far from most objects.
    nearest = shape.sdf(middle) - shape.lipschitz * length / 2.0
    line, number = torch.nonzero(nearest < FAR * blur, as_tuple=True)
    along = (torch.arange(SAMPLES, dtype=torch.float64)[:, None] + 0.5) / SAMPLES - 0.5
    point = middle[line, number, None] + step[line, None] * along
    inside = torch.sigmoid(-shape.sdf(point) / blur).mean(-1) * length[line, number]
    return torch.zeros_like(length[:, 0]).index_add(0, line, inside)


# as columns of the tables


def entries() -> dict[str, Entry]:
    """The floor plan alone, and with what it leaves as levels and fields."""
    physics = FloorPlan(Scene.from_usd(SCENE))
    what = (
        "straight lines through the blurred objects of the floor plan, each with a loss that is learned; "
        "a pattern and an offset of each gateway, the power that is sent, one reverberant power"
    )
    ours = ("required", "residual", "levels", "mixture")
    base = ("kriging", "gaussian_process", "log_distance")
    return {
        "rfsg floor plan": entry(physics, (), what),
        "rfsg floor plan + residual": entry(
            Required(physics, Residual(physics)),
            (*base, *(f"../{name}" for name in ours)),
            "the same, and what it leaves as levels and fields over both positions; the floor plan alone "
            "where a fifth of the training places, held out, does not ask for more",
        ),
    }


def entry(method: Method, names: tuple[str, ...], said: str) -> Entry:
    told = f"{method!r}{code(Path(__file__))}{SCENE.read_text()}"
    return Entry(
        lambda case: method,
        version(*names, budget=told),
        said,
        baseline=False,
        data_set="tetam-ble",
    )
