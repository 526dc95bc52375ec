"""The log-distance law: rssi = a - 10 n log10(d / 1 m) + offset of the gateway."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.learn.baselines.readings import Prediction, Readings, check_links, distance


@dataclass(frozen=True)
class LogDistance:
    """One exponent and intercept for the network, and an offset for each gateway heard.

    T. S. Rappaport, Wireless Communications, 2nd ed., section 4.9.1 (log-distance path loss), fitted
    by ordinary least squares. With ``offsets`` false the gateways share one intercept.
    """

    offsets: bool = True

    def fit(self, readings: Readings, seed: int = 0) -> "LogDistanceLaw":
        """Least squares, the solution of least norm where readings are too few or all equally far.

        Nothing is random: ``seed`` is not used.
        """
        heard, column = np.unique(readings.gateway, return_inverse=True)
        decades = slope(readings.tx_position, readings.rx_position)
        ones = np.zeros((len(readings), len(heard) if self.offsets else 1))
        ones[np.arange(len(readings)), column if self.offsets else 0] = 1.0
        # Centred, so that where the slope is not determined (all links equally long) least norm
        # makes it 0 and leaves the level to the intercepts.
        level, far = readings.rssi.mean(), decades.mean()
        basis = np.column_stack([ones, decades - far])
        found = np.linalg.lstsq(basis, readings.rssi - level, rcond=None)[0]
        exponent = float(found[-1])
        intercepts = found[:-1] + level - exponent * far
        rest = readings.rssi - level - basis @ found
        freedom = max(len(readings) - basis.shape[1], 1)
        std = float(np.sqrt((rest**2).sum() / freedom))
        intercept = float(intercepts.mean())
        gateways = heard if self.offsets else heard[:0]
        offset = intercepts - intercept if self.offsets else intercepts[:0]
        return LogDistanceLaw(intercept, exponent, gateways, offset, std)


@dataclass(frozen=True)
class LogDistanceLaw:
    """A fitted law: ``intercept`` [dBm] at 1 m, ``exponent``, ``offset`` [dB] of each ``gateways``.

    A gateway that is not among ``gateways`` has offset 0, the mean of those heard. ``std`` [dB] is
    that of the residuals, the same for every link.
    """

    intercept: float
    exponent: float
    gateways: Int[ndarray, "g"]
    offset: Float[ndarray, "g"]
    std: float

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        """Mean [dBm] and standard deviation [dB] of links between positions in metres.

        Raises ValueError when lengths differ or a position is not finite.
        """
        check_links(tx_position, rx_position, gateway)
        mean = self.intercept + self.exponent * slope(tx_position, rx_position)
        if len(self.gateways):
            at = np.minimum(np.searchsorted(self.gateways, gateway), len(self.gateways) - 1)
            mean = mean + np.where(self.gateways[at] == gateway, self.offset[at], 0.0)
        return Prediction(mean, np.full(len(mean), self.std))


def slope(
    tx_position: Float[ndarray, "n 3"], rx_position: Float[ndarray, "n 3"]
) -> Float[ndarray, "n"]:
    """-10 log10(d / 1 m): what one unit of the exponent adds [dB]."""
    return -10.0 * np.log10(distance(tx_position, rx_position))
