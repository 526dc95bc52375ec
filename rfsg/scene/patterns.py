"""Measured antenna patterns: samples on a grid of directions, and the files that hold them.

Between samples amplitudes are interpolated bilinearly in theta and phi, round and round in phi. At
the poles all phi are one direction: the samples there are made one value, the mean. The interpolant
is continuous, and differentiable but on the lines of the grid.

Gains are taken as they stand: their mean over the sphere is 1 for a lossless antenna, less for one
with losses or with a mismatch in its numbers. It is reported (``Pattern.mean_gain``) and never made 1.
"""

import csv
import io
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from numpy import ndarray
from torch import Tensor

from rfsg.scene.antennas import angles
from rfsg.scene.errors import SceneError

SUFFIXES = (".csv", ".msi", ".pln")
MAX_PATTERN_BYTES = 128 * 2**20
MAX_SAMPLES = 2**20  # a grid of a quarter of a degree
MAX_CUT = 3600  # lines of one cut of a Planet file
MAX_FAULTS = 20  # of one file
LARGEST_MEAN_GAIN = 100.0  # 20 dB more than it is given: no antenna, a mistaken unit
PASSIVE_DB = 0.5  # a mean gain above this is told
DBD = 2.15  # [dBi] of a half-wave dipole, the reference of dBd
GAIN = ("gain_dbi",)
FIELD = ("e_theta_re", "e_theta_im", "e_phi_re", "e_phi_im")


@dataclass(frozen=True, eq=False)
class Pattern:
    """An antenna known by samples of its amplitude over the sphere.

    theta [rad] runs from 0 to pi, phi [rad] once around: its last is its first, one turn on.
    samples: (E_theta, E_phi) in the antenna's own frame, |E|^2 the gain over isotropic. vector: the
    two were measured; else only a gain was, and it stands in E_theta. file: where it was read.
    """

    name: str
    theta: Float[Tensor, "t"]
    phi: Float[Tensor, "p"]
    samples: Complex[Tensor, "t p 2"]
    vector: bool
    file: str | None = None

    @staticmethod
    def from_file(path: str | Path) -> "Pattern":
        """Read a .csv, .msi or .pln file; see ``parse``. SceneError lists faults by file and line."""
        path = Path(path)
        try:
            size = path.stat().st_size
            if size > MAX_PATTERN_BYTES:
                raise SceneError([f"{path}: {size} bytes; the limit is {MAX_PATTERN_BYTES}"])
            data = path.read_bytes()
        except OSError as error:
            raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
        return parse(data, str(path), str(path))

    @staticmethod
    def from_samples(
        name: str,
        theta_deg: Float64[ndarray, "t"],
        phi_deg: Float64[ndarray, "p"],
        samples: Complex[Tensor, "t p 2"] | Float[Tensor, "t p"],
        file: str | None = None,
    ) -> "Pattern":
        """A pattern from a grid: complex (E_theta, E_phi), or real amplitudes sqrt(G).

        theta_deg: rising from 0 to 180. phi_deg: rising; one whole turn with or without its end.
        Raises SceneError for a grid that is not so, and for a mean gain of more than 100.
        """
        faults = _grid_faults(theta_deg, phi_deg)
        if faults:
            raise SceneError([f"{name}: {fault}" for fault in faults])
        vector = samples.is_complex()
        if not vector:
            samples = torch.stack([samples, torch.zeros_like(samples)], -1)
        samples = samples.to(torch.complex128)
        if phi_deg[-1] - phi_deg[0] < 360.0:  # close the turn
            phi_deg = np.append(phi_deg, phi_deg[0] + 360.0)
            samples = torch.cat([samples, samples[:, :1]], 1)
        else:
            end = (samples[:, :1] + samples[:, -1:]) / 2
            samples = torch.cat([end, samples[:, 1:-1], end], 1)
        theta, phi = (
            torch.from_numpy(np.deg2rad(a)).to(samples.device) for a in (theta_deg, phi_deg)
        )
        pole = _one_vector if vector else _one_power
        north, south = pole(samples[0], phi, 1.0), pole(samples[-1], phi, -1.0)
        samples = torch.cat([north[None], samples[1:-1], south[None]])
        pattern = Pattern(name, theta, phi, samples, vector, file)
        finite = bool(torch.isfinite(torch.view_as_real(samples.detach())).all())
        mean = pattern.mean_gain() if finite else math.inf
        if not mean <= LARGEST_MEAN_GAIN:
            raise SceneError(
                [f"{name}: the mean gain over the sphere is {_db(mean):.1f} dB, where a passive "
                 "antenna has 0 or less; expected gains in dBi, fields with |E|^2 the gain"]
            )  # fmt: skip
        return pattern

    def field(self, direction: Float[Tensor, "*b 3"]) -> Complex[Tensor, "*b 2"]:
        """(E_theta, E_phi) along unit directions in the radio's own frame."""
        theta, phi = angles(direction)
        around = self.phi.to(direction)
        turned = around[0] + torch.remainder(phi - around[0], 2.0 * math.pi)
        i, t = _cell(self.theta.to(direction), theta)
        j, s = _cell(around, turned)
        table = self.samples.to(direction.device, direction.dtype.to_complex())
        t, s = t[..., None], s[..., None]
        low = (1.0 - s) * table[i, j] + s * table[i, j + 1]
        high = (1.0 - s) * table[i + 1, j] + s * table[i + 1, j + 1]
        return (1.0 - t) * low + t * high

    def amplitude(self, direction: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """sqrt(G) = |E| along unit directions in the radio's own frame."""
        field = self.field(direction)
        power = (field.real**2 + field.imag**2).sum(-1)
        dark = power == 0  # the root has no gradient there
        root = torch.sqrt(torch.where(dark, torch.ones_like(power), power))
        return torch.where(dark, torch.zeros_like(power), root)

    def mean_gain(self) -> float:
        """Mean of the gain over the sphere: the share of its power that the antenna radiates.

        Of the interpolant itself: exact in phi, Gauss-Legendre with four nodes per step of theta.
        """
        samples, step, total = self.samples.detach(), self.theta.diff(), 0.0
        for node, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True):
            t = (1.0 + node) / 2.0
            row = (1.0 - t) * samples[:-1] + t * samples[1:]
            a, b = row[:, :-1], row[:, 1:]
            # the mean of |a + (b - a) s|^2 over s in [0, 1]
            square = (a.abs() ** 2 + b.abs() ** 2 + (a * b.conj()).real).sum(-1) / 3.0
            ring = (square * self.phi.diff()).sum(-1)
            total += (
                weight / 2.0 * float((step * torch.sin(self.theta[:-1] + t * step) * ring).sum())
            )
        return total / (4.0 * math.pi)

    def warnings(self) -> tuple[str, ...]:
        """What a user should know about the numbers, in sentences."""
        db = _db(self.mean_gain())
        if db <= PASSIVE_DB:
            return ()
        return (
            f"pattern {self.name}: the mean gain over the sphere is {db:.1f} dB: it radiates more "
            "power than it is given",
        )

    def same(self, other: "Pattern") -> bool:
        """Whether the two hold the same samples."""
        mine, theirs = (
            (p.theta, p.phi, torch.view_as_real(p.samples.detach())) for p in (self, other)
        )
        return self.vector == other.vector and all(
            a.shape == b.shape and torch.allclose(a, b.to(a), rtol=1e-12, atol=1e-15)
            for a, b in zip(mine, theirs, strict=True)
        )

    def csv(self) -> bytes:
        """The samples as a CSV file that reads back as they are, up to rounding."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(("theta_deg", "phi_deg", *(FIELD if self.vector else GAIN)))
        theta, phi = (torch.rad2deg(a).tolist() for a in (self.theta, self.phi))
        samples = self.samples.detach().cpu()
        values = torch.view_as_real(samples).flatten(2)
        if not self.vector:
            values = 20.0 * torch.log10(samples[..., :1].abs())
        for t, row in zip(theta, values.tolist(), strict=True):
            for p, cells in zip(phi[:-1], row[:-1], strict=True):
                writer.writerow(map(repr, (t, p, *cells)))
        return out.getvalue().encode()

    def __str__(self) -> str:
        return f"{self.name} (mean gain {_db(self.mean_gain()):.1f} dB)"


def parse(data: bytes, where: str, file: str | None = None) -> Pattern:
    """A pattern from the bytes of a file; the ending of ``where`` names the format.

    .csv: columns theta_deg, phi_deg and either gain_dbi, or e_theta_re, e_theta_im, e_phi_re and
    e_phi_im with |E|^2 the gain over isotropic. The lines are a full grid, in any order: theta from 0
    to 180, phi one whole turn with or without its end. A gain of -inf is a null.

    .msi, .pln (Planet): GAIN in dBd unless it says dBi, then HORIZONTAL and VERTICAL with so many
    lines "angle attenuation". Angle 0 is the boresight and the horizon; horizontal angles grow to the
    right (clockwise from above), vertical ones downward. The two cuts are combined by the usual sum
    of their attenuations (the "summing" method that Gil et al., IEEE Antennas Propag. Mag. 43(2),
    2001, and Vasiliadis et al., IEEE Trans. Antennas Propag. 53(7), 2005, compare others with), the
    front half of the vertical cut for all azimuths. It is exact on the horizon and on the front half
    of the vertical cut; off them it takes too much away, most so behind the antenna.

    Raises SceneError listing the faults (at most 20), each with ``where`` and the line.
    """
    suffix = Path(where).suffix.lower()
    if suffix not in SUFFIXES:
        raise SceneError([f"{where}: expected a pattern file ending in {', '.join(SUFFIXES)}"])
    if len(data) > MAX_PATTERN_BYTES:
        raise SceneError([f"{where}: {len(data)} bytes; the limit is {MAX_PATTERN_BYTES}"])
    try:
        text = data.decode("utf-8-sig" if suffix == ".csv" else "latin-1")
    except UnicodeDecodeError as error:
        raise SceneError([f"{where}: not UTF-8 text: byte {error.start}"]) from error
    read = _read_csv if suffix == ".csv" else _read_planet
    theta, phi, samples = read(text, where)
    pattern = Pattern.from_samples(where, theta, phi, samples, file)
    return replace(pattern, name=os.path.basename(where))


# ---- the grid ---------------------------------------------------------------------------------


def _cell(grid: Float[Tensor, "n"], x: Tensor) -> tuple[Tensor, Tensor]:
    """The interval of a rising grid that holds x, and how far along it x lies, in [0, 1]."""
    i = torch.searchsorted(grid, x.detach().contiguous(), right=True) - 1
    i = i.clamp(0, len(grid) - 2)
    return i, ((x - grid[i]) / (grid[i + 1] - grid[i])).clamp(0.0, 1.0)


def _one_vector(row: Complex[Tensor, "p 2"], phi: Tensor, up: float) -> Complex[Tensor, "p 2"]:
    """A pole's samples as the components of one vector, the mean.

    theta-hat is (up cos phi, up sin phi) and phi-hat (-sin phi, cos phi) there, in x and y.
    """
    cos, sin = torch.cos(phi), torch.sin(phi)
    theta_hat, phi_hat = torch.stack([up * cos, up * sin], -1), torch.stack([-sin, cos], -1)
    mean = (row[:-1, :1] * theta_hat[:-1] + row[:-1, 1:] * phi_hat[:-1]).mean(0)
    return torch.stack([(theta_hat * mean).sum(-1), (phi_hat * mean).sum(-1)], -1)


def _one_power(row: Complex[Tensor, "p 2"], phi: Tensor, up: float) -> Complex[Tensor, "p 2"]:
    """A pole's gains as one gain, the mean."""
    mean = (row[:-1].abs() ** 2).mean(0)
    root = torch.where(mean > 0, torch.sqrt(torch.where(mean > 0, mean, 1.0)), 0.0)
    return root.to(row.dtype).expand_as(row)


def _grid_faults(theta: ndarray, phi: ndarray) -> list[str]:
    faults = []
    rising = len(theta) >= 2 and bool((np.diff(theta) > 0).all())
    if not (rising and theta[0] == 0.0 and abs(theta[-1] - 180.0) < 1e-9):
        ends = f"{theta[0]:g} to {theta[-1]:g}" if len(theta) else "nothing"
        faults.append(f"theta_deg: expected samples from 0 to 180, got {ends}")
    if not (len(phi) and bool((np.diff(phi) > 0).all()) and phi[-1] - phi[0] <= 360.0 + 1e-9):
        ends = f"{phi[0]:g} to {phi[-1]:g}" if len(phi) else "nothing"
        faults.append(f"phi_deg: expected samples within one turn of 360, got {ends}")
    if len(theta) * len(phi) > MAX_SAMPLES:
        faults.append(f"{len(theta)} x {len(phi)} samples; the limit is {MAX_SAMPLES}")
    return faults


def _db(power: float) -> float:
    return 10.0 * math.log10(power) if power > 0 else -math.inf


# ---- files ------------------------------------------------------------------------------------

Grid = tuple[ndarray, ndarray, Tensor]  # theta [deg], phi [deg], samples as ``from_samples`` takes


class _Faults(list[str]):
    """Faults of one file; raises when there are more than anybody reads."""

    def add(self, where: str, fault: str) -> None:
        self.append(f"{where}: {fault}")
        if len(self) >= MAX_FAULTS:
            raise SceneError([*self, f"{where}: no more is read after {MAX_FAULTS} faults"])

    def done(self) -> None:
        if self:
            raise SceneError(self)


def _read_csv(text: str, where: str) -> Grid:
    faults = _Faults()
    lines = csv.reader(io.StringIO(text), skipinitialspace=True)
    try:
        head = [c.strip() for c in next(lines, [])]
        values = GAIN if GAIN[0] in head else FIELD
        columns = ("theta_deg", "phi_deg", *values)
        for c in columns:
            if head.count(c) != 1:
                faults.add(
                    f"{where}:1", f"column {c!r} {'is missing' if c not in head else 'twice'}"
                )
        for c in head:
            if c not in columns:
                faults.add(f"{where}:1", f"column {c!r} is unknown; expected {', '.join(columns)}")
        faults.done()
        order = [head.index(c) for c in columns]
        table: dict[tuple[float, float], list[float]] = {}
        for row in lines:
            here = f"{where}:{lines.line_num}"
            if not row:
                continue
            if len(row) != len(head):
                faults.add(here, f"expected {len(head)} cells, got {len(row)}")
                continue
            if len(table) >= MAX_SAMPLES:
                faults.add(here, f"more than {MAX_SAMPLES} samples")
                break
            numbers = _numbers([row[k] for k in order])
            if numbers is None:
                for k, c in zip(order, columns, strict=True):
                    _number(row[k], c, here, faults)
                continue
            place = (numbers[0], numbers[1])
            if place in table:
                faults.add(here, f"theta_deg {place[0]:g}, phi_deg {place[1]:g} stands twice")
            table[place] = numbers[2:]
    except csv.Error as error:
        faults.add(f"{where}:{lines.line_num}", f"not CSV: {error}")
    faults.done()
    theta, phi = (np.unique([place[k] for place in table]) for k in (0, 1))
    if len(theta) * len(phi) != len(table):
        lacking = next(((t, p) for t in theta for p in phi if (t, p) not in table), None)
        at = f"; theta_deg {lacking[0]:g}, phi_deg {lacking[1]:g} is missing" if lacking else ""
        raise SceneError([f"{where}: expected a full grid of {len(theta)} x {len(phi)} lines{at}"])
    grid = np.array([table[t, p] for t in theta.tolist() for p in phi.tolist()])
    samples = torch.from_numpy(grid.reshape(len(theta), len(phi), len(values)))
    if values == GAIN:
        return theta, phi, 10.0 ** (samples[..., 0] / 20.0)
    return theta, phi, torch.view_as_complex(samples.reshape(len(theta), len(phi), 2, 2))


def _numbers(cells: list[str]) -> list[float] | None:
    """A line's numbers, or None where ``_number`` has a fault to tell."""
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError:
        return None
    null = len(numbers) == 3 and numbers[2] == -math.inf  # a gain of nothing
    return numbers if all(map(math.isfinite, numbers[: 2 if null else None])) else None


def _number(text: str, column: str, where: str, faults: _Faults) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if math.isfinite(number) or (column == GAIN[0] and number == -math.inf):
        return number
    faults.add(where, f"{column}: expected a finite number, got {text.strip()[:40]!r}")
    return 0.0


def _read_planet(text: str, where: str) -> Grid:
    faults = _Faults()
    cuts: dict[str, tuple[ndarray, ndarray]] = {}
    gain: float | None = None
    lines = enumerate(text.splitlines(), 1)
    for number, line in lines:
        key, _, rest = line.strip().replace("\t", " ").partition(" ")
        here = f"{where}:{number}"
        if key.upper() == "GAIN":
            gain = _planet_gain(rest, here, faults)
        elif key.upper() in ("HORIZONTAL", "VERTICAL"):
            cuts[key.upper()] = _cut(rest, key.upper(), lines, where, number, faults)
    for key in ("HORIZONTAL", "VERTICAL"):
        if key not in cuts:
            faults.add(where, f"{key}: the cut is missing")
    if gain is None:
        faults.add(where, "GAIN: is missing; expected a number of dBd, or of dBi where it says so")
    faults.done()
    assert gain is not None  # or there was a fault
    theta, phi = np.arange(181.0), np.arange(360.0)
    horizontal = np.interp(-phi, *cuts["HORIZONTAL"], period=360.0)
    vertical = np.interp(theta - 90.0, *cuts["VERTICAL"], period=360.0)
    level = torch.from_numpy(gain - vertical[:, None] - horizontal[None])
    return theta, phi, 10.0 ** (level / 20.0)


def _planet_gain(text: str, where: str, faults: _Faults) -> float:
    """[dBi] of "17.5", "17.5 dBd" or "17.5 dBi"."""
    plain = text.strip().lower()
    offset = 0.0 if plain.endswith("dbi") else DBD
    number = plain.removesuffix("dbi").removesuffix("dbd")
    return offset + _number(number, "GAIN", where, faults)


def _cut(
    text: str, key: str, lines: Iterator[tuple[int, str]], where: str, head: int, faults: _Faults
) -> tuple[ndarray, ndarray]:
    """Angles [deg] and attenuations [dB] of the lines that follow a cut's head."""
    count = int(text) if re.fullmatch(r"\s*[0-9]{1,5}\s*", text) else 0
    if not 1 <= count <= MAX_CUT:
        given = text.strip()[:40]
        faults.add(f"{where}:{head}", f"{key}: expected 1 to {MAX_CUT} lines, got {given!r}")
        faults.done()
    cut: dict[float, float] = {}
    for _ in range(count):
        number, line = next(lines, (head, ""))
        here, cells = f"{where}:{number}", line.split()
        if len(cells) != 2:
            wanted = f"{count} lines of angle and attenuation"
            faults.add(here, f"{key}: expected {wanted}, got {line[:40]!r} after {len(cut)}")
            faults.done()
        angle, loss = (_number(cell, key, here, faults) for cell in cells)
        if loss < 0:
            faults.add(here, f"{key}: expected an attenuation of 0 dB or more, got {cells[1]!r}")
        if angle % 360.0 in cut:
            faults.add(here, f"{key}: the angle {cells[0]} stands twice")
        cut[angle % 360.0] = loss
    return np.array(list(cut)), np.array(list(cut.values()))
