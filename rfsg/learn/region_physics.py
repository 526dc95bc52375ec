"""Regions as a method among others: from received readings to predictions at other positions."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from rfsg.learn.baselines.readings import LEAST_DISTANCE, Prediction, Readings, check_links
from rfsg.learn.fit import Fitted
from rfsg.learn.losses import residual_db
from rfsg.learn.measurements import Measurements
from rfsg.learn.regions import Budget, learned, region_scene


@dataclass(frozen=True)
class RegionPhysics:
    """Regions learned from received readings: a ``Method`` (``rfsg.learn.baselines``).

    Sizes as in ``region_scene`` [m]; frequency_hz of all readings.
    """

    cell_m: float = 3.0
    margin_m: float = 0.5
    height_m: float | None = None
    frequency_hz: float = 2.44e9
    budget: Budget = field(default_factory=Budget)

    def fit(self, readings: Readings, seed: int = 0) -> "RegionPredictor":
        """Raises LearnError as ``region_scene`` and ``rfsg.fit`` do."""
        tx = _apart(readings.tx_position, readings.rx_position)
        tx, tx_of = np.unique(tx, axis=0, return_inverse=True)
        receiver = np.column_stack([readings.gateway, readings.rx_position])
        receiver, rx_of = np.unique(receiver, axis=0, return_inverse=True)
        links = torch.from_numpy(np.unique(np.column_stack([tx_of.ravel(), rx_of.ravel()]), axis=0))
        scene = region_scene(
            torch.from_numpy(tx),
            torch.from_numpy(receiver[:, 1:].copy()),
            links=links,
            cell_m=self.cell_m,
            margin_m=self.margin_m,
            height_m=self.height_m,
            seed=seed,
        )
        measured = Measurements.of(
            tx=[scene.transmitters[i].path for i in tx_of.ravel()],
            rx=[scene.receivers[i].path for i in rx_of.ravel()],
            rssi_dbm=readings.rssi.tolist(),
            frequency_hz=self.frequency_hz,
        )
        fitted = learned(scene, measured, self.budget, seed)
        gains = [fitted.gains_db.get(r.path, 0.0) for r in scene.receivers]
        heard, at = np.unique(receiver[:, 0].astype(np.int64), return_inverse=True)
        offset = np.bincount(at, np.array(gains)) / np.bincount(at)
        rest = residual_db(fitted.after, fitted.measured)
        std = float(rest.square().mean().sqrt())
        return RegionPredictor(fitted, heard, offset, std, self.frequency_hz)


@dataclass(frozen=True)
class RegionPredictor:
    """Fitted regions, ``offset`` [dB] of each of ``gateways``, ``std`` [dB] of the fit's residuals.

    A gateway that was not heard has the mean offset of those that were. ``std`` is of the training
    readings and says nothing of regions that they never crossed: a lower bound elsewhere.
    """

    fitted: Fitted
    gateways: Int[ndarray, "g"]
    offset: Float[ndarray, "g"]
    std: float
    frequency_hz: float

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
        tx = _apart(tx_position, rx_position)
        columns = {f"tx_{a}_m": tx[:, i].tolist() for i, a in enumerate("xyz")}
        columns |= {f"rx_{a}_m": rx_position[:, i].tolist() for i, a in enumerate("xyz")}
        asked = Measurements.of(**columns, rssi_dbm=[0.0] * len(tx), frequency_hz=self.frequency_hz)
        mean = self.fitted.predict(asked).rssi_dbm().numpy()
        at = np.minimum(np.searchsorted(self.gateways, gateway), len(self.gateways) - 1)
        known = self.gateways[at] == gateway
        mean = mean + np.where(known, self.offset[at], self.offset.mean())
        return Prediction(mean, np.full(len(mean), self.std))


def _apart(
    tx_position: Float[ndarray, "n 3"], rx_position: Float[ndarray, "n 3"]
) -> Float[ndarray, "n 3"]:
    """Transmitters, those nearer than LEAST_DISTANCE to their receiver put that far above it."""
    near = np.linalg.norm(tx_position - rx_position, axis=-1, keepdims=True) < LEAST_DISTANCE
    return np.where(near, rx_position + [0.0, 0.0, LEAST_DISTANCE], tx_position)
