"""NeRF2: a neural field of attenuation and of retransmitted signal, marched along rays from a receiver.

X. Zhao, Z. An, Q. Pan, L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM MobiCom 2023,
written from the paper's description. Every point p attenuates and turns a wave by delta(p), and sends
S(p, w, tx) again towards the receiver; what arrives is the sum over directions w and points along each,

    R = sum_w sum_i S(p_i, w, tx) exp(-sum_{j < i} delta(p_j) dr),   rssi = 20 log10 |R| + const.

Networks, positional encodings (10 octaves) and the skip connection are the paper's. Not the paper's:
directions spread evenly over the sphere, not over a grid of angles; the mean absolute error in dB as
loss; a smaller width and fewer rays where a budget asks for it. The phase of free space is left to the
networks, for a record of readings has no frequency.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor, nn

from rfsg.learn.baselines.readings import Prediction, Readings, check_links

# Power that is there when the sum over the rays happens to vanish: 80 dB below the level of the readings,
# under every one of them. It keeps the logarithm and its slope finite.
FLOOR = 1e-8

# Links predicted at a time: bounds the memory, not the result.
CHUNK = 64


@dataclass(frozen=True)
class Nerf2:
    """Settings; the budget is ``steps`` of Adam on ``batch`` links each, at ``rate`` with cosine decay.

    The paper's networks have ``layers`` 8 and ``width`` 256; its released settings for this kind of
    data 36 x 9 directions, 32 samples and 30 000 steps of 128.
    """

    steps: int = 30_000
    batch: int = 128
    rate: float = 1e-3
    width: int = 256
    layers: int = 8
    octaves: int = 10
    directions: int = 324
    samples: int = 32
    dtype: torch.dtype = torch.float32

    def fit(self, readings: Readings, seed: int = 0) -> "Nerf2Field":
        """Weights and batches are drawn from ``seed``; torch's own generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            field = Nerf2Field(self, readings)
            field.train_on(readings, seed)
        return field


class Nerf2Field(nn.Module):
    """A scene: both networks, the level of its readings, and its frame.

    ``history`` holds the loss [dB] of every step.
    """

    centre: Tensor
    towards: Tensor

    def __init__(self, settings: Nerf2, readings: Readings):
        super().__init__()
        s = self.settings = settings
        ends = np.concatenate([readings.tx_position, readings.rx_position])
        low, high = ends.min(0), ends.max(0)
        # Rays reach from any corner of the scene to any other; coordinates run over [-1, 1].
        self.reach = max(float(np.linalg.norm(high - low)), 1.0)
        self.level = float(readings.rssi.mean())
        self.register_buffer("centre", torch.as_tensor((low + high) / 2.0))
        self.register_buffer("towards", torch.as_tensor(even_directions(s.directions)))
        encoded = 3 * (1 + 2 * s.octaves)
        sizes = [encoded] + [s.width] * (s.layers - 1)
        self.skip = s.layers // 2
        if 0 < self.skip < s.layers:
            sizes[self.skip] += encoded
        self.attenuation = nn.ModuleList(nn.Linear(size, s.width) for size in sizes)
        self.delta = nn.Linear(s.width, 2)
        self.feature = nn.Linear(s.width, s.width)
        # The first layer of the radiance network acts on (feature, direction, transmitter) as a sum
        # of three parts, so that what is per point or per link is computed once.
        self.by_feature = nn.Linear(s.width, s.width)
        self.by_direction = nn.Linear(encoded, s.width, bias=False)
        self.by_transmitter = nn.Linear(encoded, s.width, bias=False)
        self.radiance = nn.Linear(s.width, s.width // 2)
        self.signal = nn.Linear(s.width // 2, 2)
        self.gain_db = nn.Parameter(torch.zeros(()))
        self.history: list[float] = []
        self.to(s.dtype)

    def train_on(self, readings: Readings, seed: int) -> None:
        """``settings.steps`` steps of Adam on batches drawn from ``seed``."""
        s = self.settings
        dtype = s.dtype
        tx, rx = (torch.as_tensor(p) for p in (readings.tx_position, readings.rx_position))
        rssi = torch.as_tensor(readings.rssi, dtype=dtype)
        with (
            torch.no_grad()
        ):  # starts at the right level: only differences are left to the networks
            first = slice(0, CHUNK)
            self.gain_db += (rssi[first] - self(tx[first], rx[first])).mean()
        optimizer = torch.optim.Adam(self.parameters(), s.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(s.steps, 1))
        random = np.random.default_rng(seed)
        for _ in range(s.steps):
            chosen = torch.as_tensor(random.integers(0, len(readings), s.batch))
            loss = (self(tx[chosen], rx[chosen]) - rssi[chosen]).abs().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            self.history.append(float(loss.detach()))

    def forward(self, tx: Float[Tensor, "n 3"], rx: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """RSSI [dBm] of links between positions in metres."""
        receivers, which = torch.unique(rx, dim=0, return_inverse=True)
        inner, decay, turn = self.along_rays(receivers)
        sent = self.by_transmitter(self.encode(tx))
        rays = torch.relu(inner[which] + sent[:, None, None, :])
        amplitude, phase = self.signal(torch.relu(self.radiance(rays))).unbind(-1)
        amplitude, phase = (
            amplitude.abs() * decay[which],
            2.0 * math.pi * phase.sigmoid() + turn[which],
        )
        real = (amplitude * phase.cos()).mean((1, 2))
        imaginary = (amplitude * phase.sin()).mean((1, 2))
        power = real**2 + imaginary**2 + FLOOR
        return self.level + self.gain_db + 10.0 * power.log10()

    def along_rays(
        self, rx: Float[Tensor, "g 3"]
    ) -> tuple[Float[Tensor, "g d s w"], Float[Tensor, "g d s"], Float[Tensor, "g d s"]]:
        """Of all points seen from receivers: radiance inputs, amplitude left on the way, phase."""
        s = self.settings
        step = self.reach / s.samples
        depth = (torch.arange(s.samples, dtype=torch.float64) + 0.5) * step
        points = rx[:, None, None, :] + self.towards.double()[:, None, :] * depth[:, None]
        encoded = self.encode(points)
        x = encoded
        for i, layer in enumerate(self.attenuation):
            if i == self.skip and i > 0:
                x = torch.cat([x, encoded], dim=-1)
            x = torch.relu(layer(x))
        loss, turn = self.delta(x).unbind(-1)
        # Only what lies between a point and the receiver acts on it: the sum leaves the point out.
        # Nepers per reach of the rays, so that no unit of length is built into the weights.
        loss = loss.abs() / s.samples
        before = loss.cumsum(-1) - loss
        turn = 2.0 * math.pi * turn.sigmoid()
        phase = turn.cumsum(-1) - turn
        view = self.by_direction(encode_unit(self.towards, s.octaves, s.dtype))
        return self.by_feature(self.feature(x)) + view[:, None, :], (-before).exp(), phase

    def encode(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b e"]:
        """Positional encoding of positions in metres."""
        scaled = (points - self.centre.double()) * (2.0 / self.reach)
        return encode_unit(scaled, self.settings.octaves, self.settings.dtype)

    @torch.no_grad()
    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] from positions in metres alone, so also for a gateway never heard.

        Raises ValueError when lengths differ or a position is not finite.
        """
        check_links(tx_position, rx_position, gateway)
        tx, rx = torch.as_tensor(tx_position), torch.as_tensor(rx_position)
        mean = torch.empty(len(tx), dtype=torch.float64)
        # Links of one receiver together: its rays are marched once a chunk.
        order = torch.as_tensor(np.lexsort(rx_position.T))
        for part in order.split(CHUNK):
            mean[part] = self(tx[part], rx[part]).double()
        return Prediction(mean.numpy())


def encode_unit(
    x: Float[Tensor, "*b 3"], octaves: int, dtype: torch.dtype
) -> Float[Tensor, "*b e"]:
    """(x, sin 2^k pi x, cos 2^k pi x for k below ``octaves``): NeRF2 section 4, after NeRF (2020)."""
    angle = x[..., None] * (math.pi * 2.0 ** torch.arange(octaves, dtype=torch.float64))
    parts = [x, angle.sin().flatten(-2), angle.cos().flatten(-2)]
    return torch.cat(parts, dim=-1).to(dtype)


def even_directions(count: int) -> Float[ndarray, "d 3"]:
    """Unit vectors spread evenly over the sphere: a Fibonacci lattice."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    azimuth = math.pi * (1.0 + math.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)
