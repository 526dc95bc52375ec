"""k nearest neighbours: the mean of the k readings of the same gateway closest to the transmitter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from rfsg.learn.baselines.readings import Prediction, Readings, UnheardGatewayError, check_links


@dataclass(frozen=True)
class NearestNeighbours:
    """Mean [dBm] of the nearest readings of the same gateway, by distance between transmitters.

    With several values in ``k`` the one with the least mean absolute error when every training
    reading in turn is left out is taken; the smaller on a tie.
    """

    k: Sequence[int] = (1, 2, 3, 4, 5, 7, 10, 15, 20)

    def __post_init__(self) -> None:
        if not self.k or min(self.k) < 1:
            raise ValueError(f"k: {tuple(self.k)} given; expected whole numbers of at least 1")

    def fit(self, readings: Readings, seed: int = 0) -> "Neighbourhood":
        """Nothing is random: ``seed`` is not used."""
        places = places_by_gateway(readings)
        k = min(self.k)
        if len(self.k) > 1:
            off = {k: left_out_error(places, k) for k in sorted(set(self.k))}
            k = min(off, key=lambda each: off[each])
        return Neighbourhood(places, k)


@dataclass(frozen=True)
class Neighbourhood:
    """Per gateway, the transmitter positions [m] and readings [dBm] to choose from."""

    places: dict[int, tuple[Float[ndarray, "_ 3"], Float[ndarray, "_"]]]
    k: int

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
        mean = np.empty(len(gateway))
        for name in np.unique(gateway):
            known, rssi = heard(self.places, int(name))
            asked = gateway == name
            near = np.asarray(KDTree(known).query(tx_position[asked], min(self.k, len(known)))[1])
            mean[asked] = rssi[near.reshape(int(asked.sum()), -1)].mean(1)
        return Prediction(mean)


def places_by_gateway(
    readings: Readings,
) -> dict[int, tuple[Float[ndarray, "_ 3"], Float[ndarray, "_"]]]:
    """Gateway -> (transmitter positions, readings), in an order that does not depend on theirs.

    Where two readings are equally near, the choice between them must not follow the order in which
    they were given.
    """
    order = np.lexsort((readings.rssi, *readings.tx_position.T))
    sorted_ = readings.only(order)
    return {
        int(name): (sorted_.tx_position[mine], sorted_.rssi[mine])
        for name in np.unique(sorted_.gateway)
        for mine in [sorted_.gateway == name]
    }


def heard(places: dict, gateway: int) -> tuple[Float[ndarray, "_ 3"], Float[ndarray, "_"]]:
    """What is known of a gateway. Raises UnheardGatewayError when that is nothing."""
    if gateway not in places:
        raise UnheardGatewayError(
            f"gateway {gateway}: no training reading; expected one of {sorted(places)}. This method "
            "has one model per gateway: ask the log-distance law or joint kriging"
        )
    return places[gateway]


def left_out_error(places: dict, k: int) -> float:
    """Mean absolute error [dB] of each reading predicted by the ``k`` nearest others."""
    off = []
    for known, rssi in places.values():
        if len(rssi) == 1:
            continue  # nothing is left to predict it from
        count = min(k, len(rssi) - 1)
        near = np.asarray(KDTree(known).query(known, count + 1)[1])
        # Of repeated positions the reading itself need not come first.
        mine = near == np.arange(len(rssi))[:, None]
        mine[~mine.any(1), -1] = True
        others = near[~mine].reshape(len(rssi), count)
        off.append(np.abs(rssi[others].mean(1) - rssi))
    return float(np.concatenate(off).mean()) if off else 0.0
