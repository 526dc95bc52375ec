"""Write assets/scenes/tetam_lab.usda: the laboratory of the tetam-ble data set, as boxes.

    python assets/sources/make_tetam.py DATA

DATA is the data set's folder (github philotuxo/Position-Annotated-BLE-RSSI-Dataset, CC0 1.0, with
the derived ``sensors.csv``). Only the sensors' positions are read from it. The boxes were measured
by hand in ``map/tetam.png``, in its pixels; ``occ/*.occ`` agrees with them on what a person can
walk through. Heights, thicknesses and materials are not in the data: they are guesses, and each is
written where it is used.
"""

import argparse
import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "tetam_lab.usda"

# cnf/tetam.par: the world's origin in the plan's pixels (right, down), and metres per pixel.
ORIGIN = (22.0, 9.0)
METRES_PER_PIXEL = 0.029599051601892735

CEILING = 3.0  # guess: the wall sensors hang at 2.30 m and the highest beacon stood at 2.35 m
DESK_TOP = 0.74  # guess: a usual desk
CUPBOARD_TOP = 1.16  # guess: the four sensors at 1.22 m all stand over drawn cupboards
COUNTER_TOP = 0.90  # guess: a usual kitchen counter
CONCRETE_WALL = 0.20  # guess: thickness the waves see; the boxes are as thick as drawn or more

# Desk groups and cupboards in the plan's pixels: left, top, right, bottom.
DESKS = {
    "desk_11": (55.5, 67, 128.5, 176),
    "desk_12": (207, 53, 279.5, 161),
    "desk_13": (362.5, 53, 435, 161),
    "desk_14": (509, 53.5, 582, 162),
    "desk_21": (53.5, 255, 126, 364),
    "desk_22": (201.5, 255, 274.5, 364),
    "desk_23": (342.5, 255.5, 414.5, 364),
    "desk_24": (484.5, 255, 557.5, 364),
    "desk_31": (49.5, 456, 123, 565),
    "desk_32": (196.5, 456, 269, 565),
    "desk_33": (342.5, 457, 415, 565.5),
}
# A desk group is a cross; a box of the same area keeps the length and takes this width [m].
DESK_WIDTH = 2.45
DESK_THICKNESS = 0.03

CUPBOARDS = {
    "cupboard_11": (63.5, 177.5, 120, 190),
    "cupboard_12": (215, 163, 271, 175),
    "cupboard_13": (371, 163, 426.5, 175),
    "cupboard_14": (519, 163.5, 575, 175.5),
    "cupboard_21": (62, 241.5, 89, 253),
    "cupboard_22": (237.5, 241.5, 264.5, 253),
    "cupboard_23": (351, 242.5, 407, 254),
    "cupboard_24": (493, 242.5, 549, 253.5),
    "cupboard_31": (59, 443, 114.5, 455),
    "cupboard_32": (199, 425.5, 210.4, 453),
    "cupboard_33": (236.5, 426, 250, 452.5),
    "cupboard_34": (437.7, 426, 449.5, 452.5),
    "cupboard_35": (434, 499, 447, 554.5),
    "cupboard_36": (486, 693, 514, 705),
}

# Concrete that stands on the floor, in metres of the data's frame: x0, x1, y0, y1.
# Faces that carry a sensor were moved back until the sensor hangs 5 cm before them: the plan and
# the sensors' coordinates disagree by up to 5 cm there, and a sensor must not be in the concrete.
WALLS = {
    "north": (-0.20, 0.0, -0.41, 18.0),
    "west_upper": (0.0, 10.44, -0.41, 0.0),
    "west_lower": (12.28, 18.80, -0.41, 0.22),  # sensor42
    "east_upper": (0.0, 8.61, 17.69, 18.0),  # sensor22
    "east_step": (8.61, 10.44, 16.85, 18.0),  # two steps of 9 cm drawn, one kept
    "east_pier": (12.28, 13.23, 16.88, 18.0),  # sensor31
    "east_niche": (13.23, 15.73, 17.69, 18.0),
    "east_lower": (15.73, 18.80, 16.69, 18.0),
    "south": (20.66, 20.86, -0.41, 18.0),
}
COLUMNS = {
    "corner": (0.0, 0.72, 0.0, 0.12),
    "pilaster_1": (0.0, 0.66, 5.74, 6.19),  # sensor12
    "pilaster_2": (0.0, 0.71, 11.72, 12.17),  # sensor21
    "pilaster_3": (5.92, 7.13, 0.0, 0.68),  # sensor11
    "column_11": (6.36, 7.04, 5.58, 6.28),
    "column_12": (6.36, 7.04, 11.60, 12.28),
    "column_21": (12.34, 13.02, 5.59, 6.30),
    "column_22": (12.34, 13.02, 11.60, 12.28),
    "column_31": (17.82, 18.80, 5.54, 6.75),  # sensor41
    "column_32": (18.17, 18.80, 11.60, 12.28),  # sensor32
}
COUNTER = (13.23, 15.73, 16.98, 17.68)

STAGE_DOC = """The laboratory of the tetam-ble data set (Danis, Naskali, Cemgil, Ersoy,
Pervasive and Mobile Computing 81, 2022; CC0 1.0), written by assets/sources/make_tetam.py.

Frame: the data's own. Metres, right-handed, z up from the floor; x runs down and y to the right in
the published plan; the tested area is 0..20.66 m by 0..17.64 m.

Measured: the plan of walls, columns, desks and cupboards (to about a pixel, 3 cm), the sensors.
Guessed: every height but the sensors', every thickness, every material. Left out: chairs, people,
sofa, armchair, monitors, desk screens, three small unlabelled items, lamps, any false ceiling,
doors, windows (the plan shows none) and whatever lies beyond the four openings, which are left
open because people walked through two of them.

Radios: the twelve fixed sensors were the receivers and a carried beacon the transmitter. Here the
sensors are transmitters and the beacon's places are receivers (added by benchmarks/tetam.py): path
gain is the same both ways, and twelve launches serve all places."""

MATERIALS = {
    "ConcreteWall": (
        "slab",
        "concrete",
        CONCRETE_WALL,
        "Guess: nothing says what the walls, floor and ceiling are made of, or how thick they are.",
    ),
    "ConcreteColumn": (
        "slab",
        "concrete",
        None,
        "Guess: solid concrete, as thick as the column.",
    ),
    "DeskTop": (
        "slab",
        "chipboard",
        DESK_THICKNESS,
        "Guess: chipboard; the metal frames of real desks are left out.",
    ),
    "Cupboard": (
        "slab",
        "chipboard",
        0.036,
        "Guess: an empty cupboard, two chipboard panels of 18 mm; its contents are unknown.",
    ),
}


@dataclass(frozen=True)
class Box:
    """An upright box: extent [m] along x, y, z as (low, high) pairs, its material, why it is so."""

    group: str
    name: str
    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    material: str
    doc: str


def world(left: float, top: float, right: float, bottom: float) -> tuple[float, ...]:
    """Pixels of the plan to x0, x1, y0, y1 in metres: x runs down the picture, y to the right."""
    x0, x1 = ((v - ORIGIN[1]) * METRES_PER_PIXEL for v in (top, bottom))
    y0, y1 = ((v - ORIGIN[0]) * METRES_PER_PIXEL for v in (left, right))
    return x0, x1, y0, y1


def boxes() -> Iterator[Box]:
    shell = "Guess: concrete, {}. The plan shows neither doors nor glass."
    yield Box(
        "Shell",
        "floor",
        (-0.20, 20.86),
        (-0.41, 18.0),
        (-CONCRETE_WALL, 0.0),
        "ConcreteWall",
        "Guess: concrete slab of 0.2 m, bare.",
    )
    yield Box(
        "Shell",
        "ceiling",
        (-0.20, 20.86),
        (-0.41, 18.0),
        (CEILING, CEILING + CONCRETE_WALL),
        "ConcreteWall",
        "Guess: height 3.0 m (sensors hang at 2.30 m), concrete, no false ceiling.",
    )
    for name, (x0, x1, y0, y1) in WALLS.items():
        doc = shell.format("floor to ceiling")
        yield Box("Shell", name, (x0, x1), (y0, y1), (0.0, CEILING), "ConcreteWall", doc)
    for name, (x0, x1, y0, y1) in COLUMNS.items():
        doc = "Guess: concrete from floor to ceiling; drawn as an empty outline."
        yield Box("Columns", name, (x0, x1), (y0, y1), (0.0, CEILING), "ConcreteColumn", doc)
    for name, pixels in DESKS.items():
        x0, x1, y0, y1 = world(*pixels)
        middle = (y0 + y1) / 2
        yield Box(
            "Furniture",
            name,
            (x0, x1),
            (middle - DESK_WIDTH / 2, middle + DESK_WIDTH / 2),
            (DESK_TOP - DESK_THICKNESS, DESK_TOP),
            "DeskTop",
            "Four desks set as a cross, as one board of the same area. Guess: top at 0.74 m.",
        )
    for name, pixels in CUPBOARDS.items():
        x0, x1, y0, y1 = world(*pixels)
        doc = "Guess: 1.16 m high, so that the sensors at 1.22 m stand on such cupboards."
        yield Box("Furniture", name, (x0, x1), (y0, y1), (0.0, CUPBOARD_TOP), "Cupboard", doc)
    x0, x1, y0, y1 = COUNTER
    doc = "Kitchen counter with sink. Guess: chipboard, 0.9 m high."
    yield Box("Furniture", "counter", (x0, x1), (y0, y1), (0.0, COUNTER_TOP), "Cupboard", doc)


def sensors(data: Path) -> Iterator[tuple[str, tuple[float, float, float]]]:
    """The sensors' names and positions [m] from ``sensors.csv``."""
    with open(data / "sensors.csv", newline="") as file:
        for row in csv.DictReader(file):
            yield row["sensor"], tuple(float(row[k]) for k in ("x_m", "y_m", "z_m"))


def number(value: float) -> str:
    return f"{round(value, 4) + 0.0:g}"


def triple(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(number(v) for v in values) + ")"


def box_text(box: Box) -> str:
    centre = tuple((low + high) / 2 for low, high in (box.x, box.y, box.z))
    size = tuple(high - low for low, high in (box.x, box.y, box.z))
    return f"""
        def Cube "{box.name}" (
            doc = "{box.doc}"
            prepend apiSchemas = ["MaterialBindingAPI"]
        )
        {{
            double size = 1
            float3[] extent = [(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)]
            rel material:binding = </World/Materials/{box.material}>
            double3 xformOp:translate = {triple(centre)}
            double3 xformOp:scale = {triple(size)}
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
        }}
"""


def material_text(name: str, model: str, itu: str, thickness: float | None, doc: str) -> str:
    line = (
        ""
        if thickness is None
        else f"\n            custom double rfsg:material:thickness = {thickness}"
    )
    return f"""
        def Material "{name}" (
            doc = "{doc}"
        )
        {{
            custom token rfsg:material:model = "{model}"
            custom token rfsg:material:itu = "{itu}"{line}
        }}
"""


def sensor_text(name: str, position: tuple[float, float, float]) -> str:
    return f"""
        def Xform "{name}"
        {{
            custom token rfsg:radio:role = "tx"
            custom double rfsg:radio:powerDbm = 0
            custom double rfsg:radio:frequencyHz = 2440000000
            custom token rfsg:radio:pattern = "isotropic"
            double3 xformOp:translate = {triple(position)}
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
"""


def scope_text(name: str, kind: str, parts: list[str]) -> str:
    return f'\n    def {kind} "{name}"\n    {{{"".join(parts)}    }}\n'


def scene_text(data: Path) -> str:
    groups: dict[str, list[str]] = {}
    for box in boxes():
        groups.setdefault(box.group, []).append(box_text(box))
    parts = [scope_text("Materials", "Scope", [material_text(k, *v) for k, v in MATERIALS.items()])]
    parts += [scope_text(name, "Xform", texts) for name, texts in groups.items()]
    parts += [scope_text("Radios", "Xform", [sensor_text(*s) for s in sensors(data)])]
    return f"""#usda 1.0
(
    defaultPrim = "World"
    doc = \"\"\"{STAGE_DOC}\"\"\"
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "World"
{{
    custom double rfsg:frequencyHz = 2440000000
{"".join(parts)}}}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("data", type=Path, help="folder of the tetam-ble data set")
    parser.add_argument("--out", type=Path, default=SCENE, help="the scene to write")
    options = parser.parse_args()
    if not (options.data / "sensors.csv").is_file():
        parser.error(f"{options.data}: expected the tetam-ble folder with sensors.csv in it")
    beside = options.out.with_suffix(".usda.part")
    beside.write_text(scene_text(options.data))
    beside.replace(options.out)
    print(f"wrote {options.out.name}: {sum(1 for _ in boxes())} boxes")


if __name__ == "__main__":
    main()
