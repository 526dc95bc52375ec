"""Kriging of readings: a log-distance trend, and what it leaves as a Gaussian field.

Universal kriging (N. Cressie, Statistics for Spatial Data, Wiley 1993, section 3.4) in the form of
GPML section 2.7: the coefficients of the trend have a Gaussian prior. The covariance is fitted by
maximum likelihood on training readings alone.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from rfsg.learn.baselines.gaussian_process import (
    Block,
    Covariance,
    Pairs,
    Posterior,
    Sites,
    Trend,
    exponential,
    matern32,
    most_likely,
)
from rfsg.learn.baselines.log_distance import LogDistance, slope
from rfsg.learn.baselines.readings import (
    Prediction,
    Readings,
    UnheardGatewayError,
    check_links,
)

# Prior standard deviations about the least-squares trend: of the intercept [dB] and of the exponent,
# wide beside what least squares leaves open, so that they matter only where readings are very few.
INTERCEPT_STD = 10.0
EXPONENT_STD = 1.0

# Bounds of every length scale [m] and standard deviation [dB]: positions are not known better than
# the first, buildings are not larger than the second; fields below 0.01 dB cannot be told from none.
SHORTEST, LONGEST = 0.05, 100.0
FAINTEST, STRONGEST = 0.01, 40.0


def per_gateway_field(q: Float[Tensor, "3"], pairs: Pairs) -> Tensor:
    """q = (noise, std, length): a field over transmitter positions for each gateway by itself."""
    return q[1] ** 2 * exponential(pairs.tx, q[2]) * pairs.same_gateway


def joint_field(q: Float[Tensor, "7"], pairs: Pairs) -> Tensor:
    """q = (noise, common std, length, joint std, transmitter length, receiver length, offset std).

    A field over transmitter positions that all gateways share, a field over both positions, and an
    offset per gateway. The common field is Matern 3/2: on crop S of nerf2-ble it had the likelihood
    of an exponential one, and left smaller errors where whole blocks are held out.
    """
    common = q[1] ** 2 * matern32(pairs.tx, q[2])
    joint = q[3] ** 2 * exponential(pairs.tx, q[4]) * exponential(pairs.rx, q[5])
    return common + joint + q[6] ** 2 * pairs.same_gateway


PER_GATEWAY = Covariance(
    per_gateway_field,
    ("noise_db", "std_db", "length_m"),
    start=(3.0, 6.0, 2.0),
    least=(FAINTEST, FAINTEST, SHORTEST),
    most=(STRONGEST, STRONGEST, LONGEST),
)
JOINT = Covariance(
    joint_field,
    (
        "noise_db",
        "common_std_db",
        "common_length_m",
        "joint_std_db",
        "joint_tx_length_m",
        "joint_rx_length_m",
        "offset_std_db",
    ),
    start=(3.0, 8.0, 2.0, 3.0, 2.0, 3.0, 1.0),
    least=(FAINTEST, FAINTEST, SHORTEST, FAINTEST, SHORTEST, SHORTEST, FAINTEST),
    most=(STRONGEST, STRONGEST, LONGEST, STRONGEST, LONGEST, LONGEST, STRONGEST),
)


@dataclass(frozen=True)
class GatewayKriging:
    """A field over transmitter positions for each gateway alone; one covariance for the network.

    The covariance is that of the greatest likelihood of all gateways together, on at most ``most``
    readings of each, drawn by the seed.
    """

    covariance: Covariance = PER_GATEWAY
    most: int = 300

    def fit(self, readings: Readings, seed: int = 0) -> "GatewayFields":
        """Readings are drawn from ``seed`` for the covariance, where there are more than ``most``.

        Raises FloatingPointError when no covariance matrix can be factorised.
        """
        trend = network_trend(readings)
        random = np.random.default_rng(seed)
        records = {
            int(name): readings.only(readings.gateway == name)
            for name in np.unique(readings.gateway)
        }
        blocks = [block(drawn(record, self.most, random)) for record in records.values()]
        q = most_likely(self.covariance, trend, blocks)
        fields = {
            name: Posterior.given(self.covariance, trend, q, block(record))
            for name, record in records.items()
        }
        return GatewayFields(fields)


@dataclass(frozen=True)
class GatewayFields:
    """One posterior a gateway."""

    fields: dict[int, Posterior]

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] and standard deviation [dB] of new readings of links between positions in metres.

        Raises ValueError when lengths differ or a position is not finite, and its kind
        UnheardGatewayError for a gateway without a reading.
        """
        check_links(tx_position, rx_position, gateway)
        mean, std = np.empty(len(gateway)), np.empty(len(gateway))
        for name in np.unique(gateway):
            if int(name) not in self.fields:
                raise UnheardGatewayError(
                    f"gateway {name}: no training reading; expected one of {sorted(self.fields)}. "
                    "Kriging per gateway cannot carry to another: ask joint kriging"
                )
            asked = gateway == name
            mean[asked], std[asked] = predicted(
                self.fields[int(name)], tx_position[asked], rx_position[asked], gateway[asked]
            )
        return Prediction(mean, std)


@dataclass(frozen=True)
class JointKriging:
    """Fields over transmitter and receiver positions together, which carry to gateways never heard.

    The covariance is that of the greatest likelihood on at most ``most`` readings drawn by the seed;
    the prediction uses all of them.
    """

    covariance: Covariance = JOINT
    most: int = 800

    def fit(self, readings: Readings, seed: int = 0) -> "JointField":
        """Readings are drawn from ``seed`` for the covariance, where there are more than ``most``.

        Raises FloatingPointError when the covariance matrix of the readings cannot be factorised.
        """
        trend = network_trend(readings)
        few = drawn(readings, self.most, np.random.default_rng(seed))
        q = most_likely(self.covariance, trend, [block(few)])
        return JointField(Posterior.given(self.covariance, trend, q, block(readings)))


@dataclass(frozen=True)
class JointField:
    """The posterior of all readings together."""

    posterior: Posterior

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] and standard deviation [dB] of new readings of links between positions in metres.

        A gateway never heard gets what its position says. Raises ValueError when lengths differ or a
        position is not finite.
        """
        check_links(tx_position, rx_position, gateway)
        return Prediction(*predicted(self.posterior, tx_position, rx_position, gateway))


def network_trend(readings: Readings) -> Trend:
    """Prior of intercept [dBm] and exponent: least squares on all readings, wide about it."""
    law = LogDistance(offsets=False).fit(readings)
    mean = torch.tensor([law.intercept, law.exponent], dtype=torch.float64)
    return Trend(mean, torch.tensor([INTERCEPT_STD, EXPONENT_STD], dtype=torch.float64))


def drawn(readings: Readings, most: int, random: np.random.Generator) -> Readings:
    """At most ``most`` readings, the same ones in whatever order the readings come."""
    order = np.lexsort((readings.rssi, readings.gateway, *readings.tx_position.T))
    return readings.only(order[np.sort(random.permutation(len(readings))[:most])])


def sites(
    tx_position: Float[ndarray, "n 3"],
    rx_position: Float[ndarray, "n 3"],
    gateway: Int[ndarray, "n"],
) -> tuple[Sites, Float[Tensor, "n 2"]]:
    """Sites, and the log-distance basis (1, -10 log10 d) there."""
    where = Sites(
        torch.as_tensor(tx_position), torch.as_tensor(rx_position), torch.as_tensor(gateway)
    )
    law = torch.as_tensor(slope(tx_position, rx_position))
    return where, torch.stack([torch.ones_like(law), law], dim=1)


def block(readings: Readings) -> Block:
    """All of some readings as one block of a Gaussian process."""
    where, basis = sites(readings.tx_position, readings.rx_position, readings.gateway)
    return Block(where, basis, torch.as_tensor(readings.rssi))


def predicted(
    posterior: Posterior,
    tx_position: Float[ndarray, "n 3"],
    rx_position: Float[ndarray, "n 3"],
    gateway: Int[ndarray, "n"],
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Mean [dBm] and standard deviation [dB] of new readings, noise included."""
    mean, variance = posterior.at(*sites(tx_position, rx_position, gateway))
    return mean.numpy(), (variance + posterior.parameters[0] ** 2).sqrt().numpy()
