"""Predictors of received power that know no physics but the distance, to compare rfsg with.

Each is a frozen record of settings with ``fit(readings, seed)``; what that returns has
``predict(tx_position, rx_position, gateway)``.
"""

from rfsg.learn.baselines.kriging import GatewayKriging, JointKriging
from rfsg.learn.baselines.log_distance import LogDistance
from rfsg.learn.baselines.mri import Mri
from rfsg.learn.baselines.nearest import NearestNeighbours
from rfsg.learn.baselines.nerf2 import Nerf2
from rfsg.learn.baselines.readings import (
    Method,
    Prediction,
    Predictor,
    Readings,
    UnheardGatewayError,
)

__all__ = [
    "GatewayKriging",
    "JointKriging",
    "LogDistance",
    "Method",
    "Mri",
    "NearestNeighbours",
    "Nerf2",
    "Prediction",
    "Predictor",
    "Readings",
    "UnheardGatewayError",
]
