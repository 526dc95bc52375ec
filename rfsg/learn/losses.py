"""How far predictions are from readings: negative log-likelihoods, each with the noise of its kind.

A residual of one noise scale costs 1/2 by every law. Readings that were not received are censored:
all that is known is that their power was below a threshold (Tobin 1958), so their loss is
-log P(power < threshold), and nothing is asked of a prediction that is far below.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from rfsg.learn.errors import LearnError
from rfsg.learn.measurements import Measurements, Quantity

LEAST_POWER = 1e-40  # path gain of -400 dB: nothing arrives, and a decibel has no slope
KNEE = 1.345  # [noise scales] of Huber's law: 95 % efficient where noise is normal (Huber 1981)
FREEDOM = 4.0  # degrees of Student's law: outliers of many scales cost their logarithm
SPLIT = -5.0  # log_ndtr by erfcx below: both forms are exact to rounding there
ROBUST = ("gaussian", "huber", "student")
CENSORING = ("tobit", "fill", "ignore")


@dataclass(frozen=True)
class Losses:
    """What readings are compared by.

    noise_db: of rssi and path gain. noise_gain: of a complex gain, as a share of its magnitude.
    noise_delay_s, noise_angle_deg: of the strongest path. law: "gaussian", "huber" or "student".
    coherent: powers are |sum of paths|^2; else the sum of |path|^2, the mean over phases.
    censoring: readings not received are "tobit", or a reading of ``fill_db`` (the paper), or
    "ignore"d. Raises LearnError for values out of range.
    """

    noise_db: float = 2.0
    noise_gain: float = 0.1
    noise_delay_s: float = 1e-9
    noise_angle_deg: float = 5.0
    law: str = "gaussian"
    coherent: bool = True
    censoring: str = "tobit"
    fill_db: float = -100.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name.startswith("noise") and not 0 < value < math.inf:
                raise LearnError(f"losses: {f.name}={value!r}: expected a finite number > 0")
        for name, known in (("law", ROBUST), ("censoring", CENSORING)):
            if getattr(self, name) not in known:
                raise LearnError(
                    f"losses: {name}={getattr(self, name)!r}: expected one of {', '.join(known)}"
                )


@dataclass(frozen=True)
class Predicted:
    """What the scene says of n readings, antennas and gain offsets included, for 1 W in.

    gain: h(f). power: path gain, coherent or not. sent_dbm: transmit power and its offset. delay [s]
    and unit directions (departure; arrival, towards where the wave comes from) are those of the
    strongest path. arrives: False where no path does; nothing else is meant there.
    """

    gain: Complex[Tensor, "n"]
    power: Float[Tensor, "n"]
    sent_dbm: Float[Tensor, "n"]
    delay: Float[Tensor, "n"]
    departure: Float[Tensor, "n 3"]
    arrival: Float[Tensor, "n 3"]
    arrives: Bool[Tensor, "n"]

    def path_gain_db(self) -> Float[Tensor, "n"]:
        """10 log10 of the power; that of LEAST_POWER where nothing arrives."""
        lit = self.arrives & (self.power > LEAST_POWER)
        return 10.0 * torch.log10(torch.where(lit, self.power, LEAST_POWER))

    def rssi_dbm(self) -> Float[Tensor, "n"]:
        """Received power [dBm]."""
        return self.path_gain_db() + self.sent_dbm


def loss(
    predicted: Predicted, measured: Measurements, how: Losses
) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Negative log-likelihood of each reading, and which of them count.

    A reading that was received where the scene has no path says nothing that a gradient could use:
    it does not count, and costs 0.
    """
    law = LAWS[how.law]
    total = torch.zeros_like(predicted.power)
    counts = predicted.arrives & measured.received
    for quantity, square in _SQUARES.items():
        i = torch.nonzero((measured.quantity == int(quantity)) & counts).squeeze(-1)
        if len(i):
            cost = square(_some(predicted, i), measured.take(i), how, law)
            total = total.index_copy(0, i, cost)
    i = torch.nonzero(~measured.received & predicted.arrives).squeeze(-1)
    if len(i) and how.censoring != "ignore":
        total = total.index_copy(0, i, _censored(_some(predicted, i), measured.take(i), how, law))
    silent = ~measured.received & torch.tensor(how.censoring != "ignore")
    return total, counts | silent


def residual_db(predicted: Predicted, measured: Measurements) -> Float[Tensor, "n"]:
    """Predicted less measured [dB] of powers, and of the magnitude of complex gains; 0 elsewhere."""
    rssi, gain_db = predicted.rssi_dbm(), predicted.path_gain_db()
    complex_db = 10.0 * torch.log10(_norm_square(measured.value).clamp(min=LEAST_POWER))
    kinds = measured.quantity
    off = torch.where(kinds == int(Quantity.RSSI), rssi - measured.value[:, 0], 0.0)
    off = torch.where(kinds == int(Quantity.PATH_GAIN), gain_db - measured.value[:, 0], off)
    return torch.where(kinds == int(Quantity.GAIN), gain_db - complex_db, off)


# laws: cost of the square of a residual in noise scales


def gaussian(square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """r^2 / 2."""
    return 0.5 * square


def huber(square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """r^2 / 2 up to KNEE, then linear (Huber 1964)."""
    far = square > KNEE**2
    size = torch.where(far, square, KNEE**2).sqrt()
    return torch.where(far, KNEE * size - 0.5 * KNEE**2, 0.5 * square)


def student(square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Student's t with FREEDOM degrees, up to a constant, r^2 / 2 for small r."""
    return 0.5 * FREEDOM * torch.log1p(square / FREEDOM)


Law = Callable[[Tensor], Tensor]
LAWS: dict[str, Law] = {"gaussian": gaussian, "huber": huber, "student": student}


def log_ndtr(z: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """log of the normal distribution function, its slope finite at every z.

    torch's own slope is 0/0 from z = -39 in float64. Below SPLIT: log(erfcx(-z / sqrt 2) / 2) - z^2/2.
    """
    low = z < SPLIT
    below, above = torch.where(low, z, SPLIT), torch.where(low, SPLIT, z)
    tail = torch.log(0.5 * torch.special.erfcx(-below * math.sqrt(0.5))) - 0.5 * below * below
    return torch.where(low, tail, torch.special.log_ndtr(above))


def tobit(
    predicted_dbm: Float[Tensor, "n"], threshold_dbm: Float[Tensor, "n"], noise_db: float
) -> Float[Tensor, "n"]:
    """-log P(reading < threshold) for normal noise about the prediction (Tobin 1958)."""
    return -log_ndtr((threshold_dbm - predicted_dbm) / noise_db)


# what each quantity is compared by


def _rssi(p: Predicted, m: Measurements, how: Losses, law: Law) -> Tensor:
    return law(((p.rssi_dbm() - m.value[:, 0]) / how.noise_db) ** 2)


def _path_gain(p: Predicted, m: Measurements, how: Losses, law: Law) -> Tensor:
    return law(((p.path_gain_db() - m.value[:, 0]) / how.noise_db) ** 2)


def _gain(p: Predicted, m: Measurements, how: Losses, law: Law) -> Tensor:
    off = torch.view_as_real(p.gain) - m.value
    return law(_norm_square(off) / (how.noise_gain**2 * _norm_square(m.value)))


def _delay(p: Predicted, m: Measurements, how: Losses, law: Law) -> Tensor:
    cost = law(((p.delay - m.value[:, 0]) / how.noise_delay_s) ** 2)
    seen = torch.cat([spherical(p.arrival), spherical(p.departure)], -1)
    turn = torch.deg2rad(m.angle) - seen
    around = torch.atan2(torch.sin(turn), torch.cos(turn))
    off = law((around / math.radians(how.noise_angle_deg)) ** 2)
    return cost + torch.where(m.has_angle, off, 0.0).sum(-1)


_SQUARES = {
    Quantity.RSSI: _rssi,
    Quantity.PATH_GAIN: _path_gain,
    Quantity.GAIN: _gain,
    Quantity.DELAY: _delay,
}


def _censored(p: Predicted, m: Measurements, how: Losses, law: Law) -> Tensor:
    if how.censoring == "fill":
        return law(((p.rssi_dbm() - how.fill_db) / how.noise_db) ** 2)
    return tobit(p.rssi_dbm(), m.threshold, how.noise_db)


def spherical(direction: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2"]:
    """(azimuth, zenith) [rad] of unit vectors; along the z axis the azimuth is 0, without slope."""
    x, y, z = direction.unbind(-1)
    level = x * x + y * y
    flat = level == 0
    x, y = torch.where(flat, 1.0, x), torch.where(flat, 0.0, y)
    across = torch.where(flat, 0.0, torch.where(flat, 1.0, level).sqrt())
    return torch.stack([torch.atan2(y, x), torch.atan2(across, z)], -1)


def _norm_square(pair: Tensor) -> Tensor:
    return (pair * pair).sum(-1)


def _some(p: Predicted, i: Tensor) -> Predicted:
    return Predicted(*(getattr(p, f.name)[i] for f in fields(Predicted)))
