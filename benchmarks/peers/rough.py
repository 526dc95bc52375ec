"""A rough wall: power, not paths, is what two tracers can agree on; summed over polarisations."""

from dataclasses import dataclass

import numpy as np
import truth
from differences import THRESHOLD, Compared, Difference
from exchange import SCATTER, Traced
from explain import SCATTERED, UNEXPLAINED
from numpy import ndarray

QUANTITY = "scattered power [dB]"


@dataclass(frozen=True)
class RoughWall:
    """One wall, traced to receivers of the transmitter's polarisation, and to receivers across it."""

    along: Compared
    across: Compared

    @property
    def name(self) -> str:
        return self.along.case.name

    @property
    def exact(self) -> ndarray:
        """[r], linear."""
        return truth.diffuse_power(self.along.case)

    def total(self, side: str) -> ndarray:
        """[r]: what a side scatters to each receiver, in both polarisations."""
        return sum((self._power(c, side) for c in (self.along, self.across)), np.zeros(1))

    def crossed(self, side: str) -> ndarray:
        """[r]: the part of it that is across."""
        return self._power(self.across, side) / self.total(side)

    def differences(self) -> dict[Difference, str]:
        """Of the power along, with the cause: its place in the other polarisation, or none."""
        along, total = (
            10 * np.log10(of("peer") / of("rfsg"))
            for of in (lambda side: self._power(self.along, side), self.total)
        )
        found = {}
        for r in np.nonzero(np.abs(along) > THRESHOLD[QUANTITY])[0]:
            same = abs(total[r]) < THRESHOLD[QUANTITY]
            difference = Difference(QUANTITY, int(r), "all scattered", float(along[r]))
            found[difference] = SCATTERED.name if same else UNEXPLAINED
        return found

    def _power(self, compared: Compared, side: str) -> ndarray:
        traced: Traced = getattr(compared, side)
        power = np.zeros(len(compared.case.receivers))
        diffuse = (traced.kind == SCATTER).any(1)
        np.add.at(power, traced.rx[diffuse], np.abs(traced.gain[diffuse]) ** 2)
        return power


def pairs(cases: list[Compared]) -> list[RoughWall]:
    """Cases that differ in the receivers' polarisation only, joined."""
    along = [c for c in cases if c.case.receiver_polarization == c.case.polarization]
    across = [c for c in cases if c not in along]
    return [RoughWall(a, b) for a in along for b in across if a.case.things == b.case.things]
