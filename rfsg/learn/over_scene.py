"""What a fitted scene leaves of measured power: levels and fields over it, kept with the scene.

``rfsg.learn.residual`` over a physics that is done: a scene knows its readings already, so what it leaves
of them is all that is modelled. The end of the links with fewer places is the gateways' (channels are
reciprocal); a level and the shared field belong to the places of the other end.

The residual belongs to the scene as it was measured. The common term (levels, the field that all
gateways share, their offsets) is of what is with the places and the radios; the field over both ends
is of what stands between them, and is left out where that was moved.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from scipy.spatial import KDTree
from torch import Tensor

from rfsg.learn.baselines.gaussian_process import Covariance
from rfsg.learn.baselines.kriging import JOINT
from rfsg.learn.baselines.readings import Prediction, Readings
from rfsg.learn.errors import LearnError
from rfsg.learn.levels import SAME_PLACE, Levels
from rfsg.learn.links import Links
from rfsg.learn.mixture import Mixture
from rfsg.learn.residual import COMMON, Fields, Residual, given, levels_of

FORMAT_VERSION = 1
LEAST = 12  # readings below which a level and seven parameters are not asked for
MOST = 6000  # readings that a field may stand on: its matrix takes 0.3 GB
MOST_BYTES = 64 * 2**20  # of a file; MOST readings with their places take 1 MB
FOLDS = 5  # parts of the training readings, each predicted from the others
AT_ONCE = 2048  # readings predicted together: bounds memory
_SAVED = [f.name for f in fields(Levels) if f.name not in ("noise", "length", "weight")]


@dataclass(frozen=True)
class ResidualSettings:
    """counts: numbers of levels to choose from. most: readings that covariances are fitted on.

    Raises LearnError for values out of range.
    """

    counts: tuple[int, ...] = (1, 2, 3, 4)
    most: int = 600

    def __post_init__(self) -> None:
        try:
            self.over_nothing()
        except ValueError as error:
            raise LearnError(f"residual: {error}") from error

    def over_nothing(self) -> Residual:
        """Of readings from which the physics is taken already."""
        return Residual(_Nothing(), counts=tuple(self.counts), most=self.most, rounds=0)

    @staticmethod
    def of(given: "bool | ResidualSettings") -> "ResidualSettings | None":
        """None for False, the standard for True."""
        if isinstance(given, ResidualSettings):
            return given
        return ResidualSettings() if given else None


def refuse_few(count: int) -> None:
    """Raises LearnError where a residual cannot stand on so many readings."""
    if count < LEAST:
        raise LearnError(
            f"residual: {count} training readings of power were received and are reached by a path; "
            f"expected at least {LEAST}. Take more readings, hold fewer for validation, or fit without "
            "a residual"
        )


class _Nothing:
    """A physics that says 0 dB of every link."""

    def fit(self, readings: Readings, seed: int = 0) -> "_Nothing":
        return self

    def predict(
        self,
        tx_position: Float[ndarray, "n 3"],
        rx_position: Float[ndarray, "n 3"],
        gateway: Int[ndarray, "n"],
    ) -> Prediction:
        return Prediction(np.zeros(len(gateway)))


@dataclass(frozen=True)
class Ends:
    """Where n readings were taken [m]: transmitters, receivers."""

    tx: Float[ndarray, "n 3"]
    rx: Float[ndarray, "n 3"]

    @staticmethod
    def of(links: Links) -> "Ends":
        """Of every reading of some links."""
        ends = ((links.transmitters, links.tx), (links.receivers, links.rx))
        tx, rx = (
            torch.stack([r.position.double().cpu() for r in radios])[which[links.link_of]].numpy()
            for radios, which in ends
        )
        return Ends(tx, rx)

    def receivers_are_places(self) -> bool:
        """Whether there are more places that receive than places that send."""
        return _places(self.rx) > _places(self.tx)

    def only(self, chosen: Bool[ndarray, "n"] | Int[ndarray, "m"]) -> "Ends":
        return Ends(self.tx[chosen], self.rx[chosen])

    def __len__(self) -> int:
        return len(self.tx)


@dataclass(frozen=True)
class SceneResidual:
    """What a scene leaves [dB] of the readings it was fitted to, and what that says of others.

    rest: the readings less the scene's predictions, the end with more places as transmitters.
    flipped: whether that end receives. whole: levels and a field over both ends; common: levels and
    the field over places that all gateways share. seed: of the draws.
    """

    rest: Readings
    flipped: bool
    whole: Fields
    common: Fields
    seed: int

    @staticmethod
    def fit(
        ends: Ends, left_db: Float[Tensor, "n"], settings: ResidualSettings, seed: int = 0
    ) -> "SceneResidual":
        """From at most MOST readings less predictions [dB]; ``seed`` draws those for the covariances.

        Raises LearnError for fewer than LEAST readings.
        """
        refuse_few(len(ends))
        flipped = ends.receivers_are_places()
        place, other = (ends.rx, ends.tx) if flipped else (ends.tx, ends.rx)
        number = np.unique(np.round(other / SAME_PLACE), axis=0, return_inverse=True)[1].ravel()
        rest = Readings(place, other, number.astype(np.int64), left_db.double().numpy())
        model = settings.over_nothing().fit(rest, seed)
        return SceneResidual(rest, flipped, model.whole.fields, model.common.fields, seed)

    def at(self, ends: Ends, *, moved: bool = False) -> Mixture:
        """Distribution of readings less what the scene predicts [dB], noise included.

        moved: of another scene than the one that was measured: the common term alone.
        """
        return _mixture(self.common if moved else self.whole, *self._sites(ends))

    def held_out(self) -> Mixture:
        """Each of the readings it stands on, as told by the other parts of FOLDS.

        Number of levels and covariance parameters are those of all: what they saw helps a little.
        """
        order = np.random.default_rng(self.seed).permutation(len(self.rest))
        part = np.empty(len(order), dtype=np.int64)
        part[order] = np.arange(len(order)) % FOLDS
        count = len(self.whole.levels.value)
        told = []
        for k in range(FOLDS):
            known, asked = self.rest.only(part != k), self.rest.only(part == k)
            found = given(levels_of(count, known), known, JOINT, self.whole.posterior.parameters)
            told.append(_mixture(found, asked.tx_position, asked.rx_position, asked.gateway))
        back = np.argsort(np.concatenate([np.flatnonzero(part == k) for k in range(FOLDS)]))
        return Mixture(*(np.concatenate(c)[back] for c in _columns(told)))

    def _sites(self, ends: Ends) -> tuple[ndarray, ndarray, ndarray]:
        """(place, gateway's position, gateway's number); a gateway that was not heard is a new one."""
        place, other = (ends.rx, ends.tx) if self.flipped else (ends.tx, ends.rx)
        apart, nearest = KDTree(self.rest.rx_position).query(other)
        new = np.unique(np.round(other / SAME_PLACE), axis=0, return_inverse=True)[1].ravel()
        unheard = new + int(self.rest.gateway.max()) + 1
        number = np.where(apart < SAME_PLACE, self.rest.gateway[nearest], unheard)
        return place, other, number.astype(np.int64)

    def told(self) -> dict[str, Any]:
        """What a person asks about it, ready for JSON."""
        levels = self.whole.levels
        return {
            "readings": len(self.rest),
            "levels_db": levels.value.tolist(),
            "shares": levels.share.tolist(),
            "places_are": "receivers" if self.flipped else "transmitters",
            "whole": _named(JOINT, self.whole),
            "common": _named(COMMON, self.common),
        }

    # files

    def pack(self) -> bytes:
        """As the bytes of a safetensors file; ``unpack`` gives the same predictions to rounding."""
        tensors = {
            "place": self.rest.tx_position,
            "gateway_position": self.rest.rx_position,
            "gateway": self.rest.gateway,
            "left_db": self.rest.rssi,
            "whole": self.whole.posterior.parameters.numpy(),
            "common": self.common.posterior.parameters.numpy(),
        }
        levels = self.whole.levels
        tensors |= {f"levels.{n}": getattr(levels, n) for n in _SAVED}
        head = {
            "formatVersion": FORMAT_VERSION,
            "flipped": self.flipped,
            "seed": self.seed,
            "levels": {n: float(getattr(levels, n)) for n in ("noise", "length", "weight")},
        }
        whole = {n: torch.from_numpy(np.ascontiguousarray(t)) for n, t in tensors.items()}
        return save_tensors(whole, metadata={"residual": json.dumps(head, sort_keys=True)})

    @staticmethod
    def unpack(path: Path) -> "SceneResidual":
        """Read a file. Raises LearnError for one that is none, too large, or not consistent."""
        try:
            if (size := path.stat().st_size) > MOST_BYTES:
                raise ValueError(f"{size} bytes; expected at most {MOST_BYTES}")
            data = path.read_bytes()
            head = _head(data)
            found = {n: t.numpy() for n, t in load_tensors(data).items()}
            if head["formatVersion"] != FORMAT_VERSION:
                raise ValueError(
                    f"format version {head['formatVersion']!r}; expected {FORMAT_VERSION}"
                )
            return _rebuilt(found, head)
        except _BROKEN as error:
            raise LearnError(f"{path}: not a residual that can be read: {error}") from error


_BROKEN = (SafetensorError, OSError, KeyError, ValueError, TypeError, FloatingPointError)


def _rebuilt(found: dict[str, ndarray], head: dict[str, Any]) -> SceneResidual:
    """Raises KeyError or ValueError where something lacks or does not fit."""
    for name, values in found.items():
        if values.dtype not in (np.float64, np.int64) or not np.isfinite(values).all():
            raise ValueError(f"tensor {name!r}: expected finite float64, or int64")
    rest = Readings(found["place"], found["gateway_position"], found["gateway"], found["left_db"])
    if len(rest) > MOST:
        raise ValueError(f"{len(rest)} readings; expected at most {MOST}")
    numbers = {n: float(v) for n, v in head["levels"].items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError("levels: expected finite numbers")
    known: dict[str, Any] = {n: found[f"levels.{n}"] for n in _SAVED}
    known.update(numbers)
    levels = Levels(**known)
    k, p = len(levels.value), len(levels.position)
    shapes = {"share": (k,), "position": (p, 3), "own": (p, k), "known": (p, k)}
    for name, shape in shapes.items():
        if getattr(levels, name).shape != shape:
            raise ValueError(f"tensor 'levels.{name}': expected shape {shape}")
    told = []
    for name, covariance in (("whole", JOINT), ("common", COMMON)):
        parameters = torch.from_numpy(found[name])
        if parameters.shape != (len(covariance.names),) or not bool((parameters > 0).all()):
            raise ValueError(f"tensor {name!r}: expected {len(covariance.names)} numbers > 0")
        told.append(given(levels, rest, covariance, parameters))
    whole, common = told
    return SceneResidual(rest, bool(head["flipped"]), whole, common, int(head["seed"]))


def _head(data: bytes) -> dict[str, Any]:
    """The metadata entry, read by hand so that its size is known before it is parsed."""
    size = int.from_bytes(data[:8], "little")
    if not 0 < size <= len(data) - 8:
        raise ValueError("not a safetensors file: its header does not fit in the file")
    return json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["residual"])


def _places(position: Float[ndarray, "n 3"]) -> int:
    return len(np.unique(np.round(position / SAME_PLACE), axis=0))


def _mixture(fields: Fields, place: ndarray, other: ndarray, gateway: ndarray) -> Mixture:
    """Some at a time."""
    some = (slice(i, i + AT_ONCE) for i in range(0, max(1, len(place)), AT_ONCE))
    parts = [fields.mixture(place[i], other[i], gateway[i]) for i in some]
    return Mixture(*(np.concatenate(c) for c in _columns(parts)))


def _columns(parts: list[Mixture]) -> Iterator[tuple[ndarray, ...]]:
    return zip(*((m.weight, m.mean, m.std) for m in parts), strict=True)


def _named(covariance: Covariance, fields: Fields) -> dict[str, float]:
    return dict(zip(covariance.names, fields.posterior.parameters.tolist(), strict=True))
