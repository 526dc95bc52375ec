"""MRI, model-based radio interpolation: a propagation law, and what it leaves, interpolated.

H. Shin, Y. Chon, Y. Kim, H. Cha, "MRI: Model-Based Radio Interpolation for Indoor War-Walking", IEEE
Transactions on Mobile Computing 14 (6), 2015, fills a fingerprint map "with an appropriate radio
propagation model"; the rfsg paper (section 5.1) and NeRF2 cite it so. Neither gives weights. Here the
law is log-distance, and the differences between readings and law are spread by inverse distance
weights (D. Shepard, "A two-dimensional interpolation function for irregularly-spaced data", 1968).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.learn.baselines.log_distance import LogDistance, LogDistanceLaw
from rfsg.learn.baselines.nearest import heard, places_by_gateway
from rfsg.learn.baselines.readings import Prediction, Readings, check_links

# Transmitters nearer than this [m] count as one place: 1 mm, below what any position is known to.
SAME_PLACE = 1e-3


@dataclass(frozen=True)
class Mri:
    """Log-distance law with gateway offsets, plus inverse-distance weighted residuals per gateway.

    ``power`` is the exponent of the distance in the weights; 2 is Shepard's.
    """

    power: float = 2.0

    def fit(self, readings: Readings, seed: int = 0) -> "MriMap":
        """Nothing is random: ``seed`` is not used."""
        law = LogDistance().fit(readings)
        said = law.predict(readings.tx_position, readings.rx_position, readings.gateway).mean
        rest = Readings(
            readings.tx_position, readings.rx_position, readings.gateway, readings.rssi - said
        )
        return MriMap(law, places_by_gateway(rest), self.power)


@dataclass(frozen=True)
class MriMap:
    """A law, and per gateway the transmitter positions [m] and the residuals [dB] there."""

    law: LogDistanceLaw
    residual: dict[int, tuple[Float[ndarray, "_ 3"], Float[ndarray, "_"]]]
    power: float

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] of links between positions in metres.

        Raises ValueError when lengths differ or a position is not finite, and its kind
        UnheardGatewayError for a gateway without a reading.
        """
        check_links(tx_position, rx_position, gateway)
        mean = self.law.predict(tx_position, rx_position, gateway).mean.copy()
        for name in np.unique(gateway):
            known, rest = heard(self.residual, int(name))
            asked = gateway == name
            apart = np.linalg.norm(tx_position[asked][:, None] - known[None], axis=-1)
            weight = np.maximum(apart, SAME_PLACE) ** -self.power
            mean[asked] += (weight @ rest) / weight.sum(1)
        return Prediction(mean)
