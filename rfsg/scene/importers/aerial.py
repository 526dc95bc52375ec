"""Aerial Omniverse Digital Twin: ``asim:material`` on a mesh names a prim that says what it is to a wave.

    eps_r = a f^b,  sigma = c f^d [S/m],  f in GHz  (ITU-R P.2040-4, Eqs. 57 and 58)

with ``thickness`` [m], ``scattering_coeff``, ``k_xpol``, and the lobe of what scatters.
"""

import math
from collections.abc import Mapping
from typing import Any

from rfsg.objects.physics.media import MATERIALS
from rfsg.scene.errors import SceneError
from rfsg.scene.importers.table import itu_material, refuse_faulty
from rfsg.scene.materials import Material

MATERIAL = "asim:material"
MESH = "AerialRFMesh"  # false: a mesh that waves do not see
FORMULA = ("a", "b", "c", "d")
SAID = (*FORMULA, "thickness", "scattering_coeff", "k_xpol", "exponent_alpha_r",
        "exponent_alpha_i", "lambda_r")  # fmt: skip
THICKNESS = 0.1  # [m] where a material says none
SAME = 1e-6  # relative: coefficients in single precision


def radio_of(said: Mapping[str, float], frequency: float | None) -> Material:
    """The wall that a material's attributes describe; by its ITU-R P.2040 name where the coefficients
    are those of one, else with constants at ``frequency`` [Hz].

    Raises SceneError where coefficients are missing or a frequency is needed, ValueError for what
    makes no material."""
    missing = [n for n in FORMULA if n not in said]
    if missing:
        raise SceneError([f"says no {', '.join(missing)} of eps_r = a f^b, sigma = c f^d"])
    if not all(map(math.isfinite, said.values())):
        raise ValueError("numbers that are not finite")
    options: dict[str, Any] = {"thickness": said.get("thickness") or THICKNESS} | _rough(said)
    a, b, c, d = (said[n] for n in FORMULA)
    for name, rows in MATERIALS.items():
        if name != "vacuum" and any(_alike(row[2:], (a, b, c, d)) for row in rows):
            return itu_material(name, **options)
    if frequency is None:
        raise SceneError(
            ["a permittivity by formula that is none of ITU-R P.2040's; give the frequency to "
             "evaluate it at"]
        )  # fmt: skip
    ghz = frequency / 1e9
    material = Material("slab", eps_r=a * ghz**b, sigma=c * ghz**d, **options)
    refuse_faulty(material)
    return material


def _alike(row: tuple[float, ...], said: tuple[float, ...]) -> bool:
    return all(
        math.isclose(x, y, rel_tol=SAME, abs_tol=1e-12) for x, y in zip(row, said, strict=True)
    )


def _rough(said: Mapping[str, float]) -> dict[str, Any]:
    """How a surface scatters; nothing where it does not."""
    share = said.get("scattering_coeff", 0.0)
    if not share:
        return {}
    rough: dict[str, Any] = {"scattering": share, "cross_share": said.get("k_xpol", 0.0)}
    alpha_r, alpha_i = (round(said.get(f"exponent_alpha_{k}", 0.0)) for k in "ri")
    if alpha_r and alpha_i:
        forward = said.get("lambda_r", 1.0)
        return rough | {
            "lobe": "backscattering",
            "alpha_r": alpha_r,
            "alpha_i": alpha_i,
            "forward_share": forward,
        }
    return rough | ({"lobe": "directive", "alpha_r": alpha_r} if alpha_r else {})
