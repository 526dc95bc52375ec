"""SimReady's non-visual materials: ``omni:simready:nonvisual:base``, a token on a USD material.

It names a substance and gives neither permittivity nor thickness. What ITU-R P.2040 knows is mapped, a
wall with the thickness usual for it; the rest is left out and said.
"""

from rfsg.scene.importers.table import itu_material
from rfsg.scene.materials import Material

BASE = "omni:simready:nonvisual:base"
METALS = (
    "aluminum", "steel", "oxidized_steel", "iron", "oxidized_iron", "silver", "brass", "bronze",
    "oxidized_bronze_patina", "tin", "carbon_fiber", "mirror", "one_way_mirror",
)  # fmt: skip
# base: (ITU-R P.2040 name, thickness [m])
WALLS = {
    "clear_glass": ("glass", 0.006),
    "frosted_glass": ("glass", 0.006),
    "ceramic_glass": ("glass", 0.01),
    "concrete": ("concrete", 0.2),
    "asphalt": ("asphalt_concrete", 0.2),
    "brick": ("brick", 0.12),
    "marble": ("marble", 0.03),
    "wood": ("wood", 0.02),
    "bark": ("wood", 0.2),
    "gravel": ("very_dry_ground", 1.0),
    "dirt": ("medium_dry_ground", 1.0),
    "mud": ("wet_ground", 1.0),
}


def radio_of(base: str) -> Material | None:
    """The wall that a base stands for, None for what ITU-R P.2040 does not know."""
    base = base.lower()
    if base in METALS:
        return Material("conductor")
    if base not in WALLS:
        return None
    itu, thickness = WALLS[base]
    return itu_material(itu, thickness=thickness)
