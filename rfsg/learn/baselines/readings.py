"""What a baseline reads and says: records of readings, predictions, and the shape of a method."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

# Distances below this count as this [m]: about a wavelength at 2.4 GHz, inside which no law of the
# distance between two antennas holds, and log10(0) has no value.
LEAST_DISTANCE = 0.1


class UnheardGatewayError(ValueError):
    """A method that keeps one model per gateway was asked about a gateway it never heard."""


@dataclass(frozen=True)
class Readings:
    """Received readings: ``rssi[i]`` [dBm] at receiver ``gateway[i]``, sent from ``tx_position[i]``.

    Positions in metres. ``gateway`` is any whole number that names the receiver: two readings of
    one number share what is learned of that receiver (its offset, its field). Readings that were not
    received are left out; a fill such as -100 dBm would be taken for a measurement.

    Raises ValueError when there is no reading, when a length differs, or when a value is NaN or
    infinite.
    """

    tx_position: Float[ndarray, "n 3"]
    rx_position: Float[ndarray, "n 3"]
    gateway: Int[ndarray, "n"]
    rssi: Float[ndarray, "n"]

    def __post_init__(self) -> None:
        if len(self.rssi) == 0:
            raise ValueError(
                "readings: none given; expected at least one received reading. Likely cause: every "
                "reading of the training set was left out as not received"
            )
        check_links(self.tx_position, self.rx_position, self.gateway)
        if len(self.rssi) != len(self.gateway):
            raise ValueError(
                f"rssi: {len(self.rssi)} values for {len(self.gateway)} links; expected one a link"
            )
        check_finite("rssi", self.rssi, "dBm; leave readings that were not received out")

    def __len__(self) -> int:
        return len(self.rssi)

    def only(self, chosen: Bool[ndarray, "n"] | Int[ndarray, "m"]) -> "Readings":
        """The readings that a mask or a list of indices chooses."""
        return Readings(
            self.tx_position[chosen],
            self.rx_position[chosen],
            self.gateway[chosen],
            self.rssi[chosen],
        )


@dataclass(frozen=True)
class Prediction:
    """Predicted readings: ``mean`` [dBm], and ``std`` [dB] of a new reading where a method has one."""

    mean: Float[ndarray, "n"]
    std: Float[ndarray, "n"] | None = None


@runtime_checkable
class Predictor(Protocol):
    """What a fit returns."""

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction: ...


@runtime_checkable
class Method(Protocol):
    """A baseline with its settings. ``fit`` draws all that is random from ``seed``."""

    def fit(self, readings: Readings, seed: int = 0) -> Predictor: ...


def check_links(
    tx_position: Float[ndarray, "n 3"],
    rx_position: Float[ndarray, "m 3"],
    gateway: Int[ndarray, "k"],
) -> None:
    """Raise ValueError unless the three have one length and every position is finite."""
    if not len(tx_position) == len(rx_position) == len(gateway):
        raise ValueError(
            f"links: {len(tx_position)} transmitter positions, {len(rx_position)} receiver positions "
            f"and {len(gateway)} gateways; expected one of each a link"
        )
    check_finite("tx_position", tx_position, "metres")
    check_finite("rx_position", rx_position, "metres")


def check_finite(name: str, values: Float[ndarray, "..."], unit: str) -> None:
    """Raise ValueError, naming ``name``, when a value is NaN or infinite."""
    bad = int((~np.isfinite(values)).sum())
    if bad:
        raise ValueError(
            f"{name}: {bad} of {values.size} values are NaN or infinite; expected finite {unit}. "
            "Likely cause: an empty cell in the table they were read from"
        )


def distance(
    tx_position: Float[ndarray, "n 3"], rx_position: Float[ndarray, "n 3"]
) -> Float[ndarray, "n"]:
    """Length of each link [m], never below LEAST_DISTANCE."""
    apart = np.linalg.norm(tx_position - rx_position, axis=-1)
    return np.maximum(apart, LEAST_DISTANCE)
