"""What people write on the command line, as values: frequencies, paths, planes, qualities.

Everything that cannot be understood raises typer.BadParameter with what was given and expected.
"""

import math
import re
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rfsg.scene.pose import Pose
    from rfsg.tracer.plan import Quality

UNITS = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9, "thz": 1e12}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
SPANS = SECONDS | {"min": 60.0, "h": 3600.0}  # of work; nothing in a channel takes a minute
HIGHEST_CREDIBLE_HZ = 1e15  # above this a unit was surely mistaken (ultraviolet light)
MOST_FREQUENCIES = 10_000  # each is a whole evaluation of all paths


def parse_frequency(text: str) -> float:
    """'2.44GHz', '868 MHz' or '2.44e9' in hertz."""
    value = _quantity(text, UNITS)
    if not 0.0 < value < HIGHEST_CREDIBLE_HZ:
        raise typer.BadParameter(f"{text!r} is not a frequency; write for example 2.44GHz")
    return value


def parse_frequencies(texts: list[str]) -> list[float]:
    """['2.4GHz,5GHz', '60GHz'] in hertz, in the order given."""
    found = [parse_frequency(part) for text in texts for part in text.split(",")]
    if len(found) > MOST_FREQUENCIES:
        raise typer.BadParameter(f"{len(found)} frequencies: expected at most {MOST_FREQUENCIES}")
    return found


def parse_duration(text: str) -> float:
    """'10ms', '2.5 us' or '0.01' in seconds."""
    value = _quantity(text, SECONDS)
    if not 0.0 < value < math.inf:
        raise typer.BadParameter(f"{text!r} is not a duration; write for example 10ms")
    return value


def parse_budget(text: str | float) -> float:
    """'2s', '5min' or '1.5h' in seconds; a default comes as the number it is."""
    value = _quantity(str(text), SPANS)
    if not 0.0 < value < math.inf:
        raise typer.BadParameter(f"{text!r} is not a time; write for example 5min")
    return value


def parse_decibel(text: str) -> float:
    """'1dB', '0.5 dB' or '1' in decibels, above 0."""
    value = _quantity(text, {"db": 1.0})
    if not 0.0 < value < math.inf:
        raise typer.BadParameter(f"{text!r} is not an accuracy; write for example 1dB")
    return value


def _quantity(text: str, units: dict[str, float]) -> float:
    """A number and one of the units, or none, in SI; 0 for what is neither."""
    match = re.fullmatch(r"\s*([0-9.]+(?:e[+-]?[0-9]+)?)\s*([a-z]*)\s*", text, re.IGNORECASE)
    try:
        number, unit = (float(match[1]), match[2].lower()) if match else (0.0, "")
    except ValueError:
        return 0.0
    return number * (units.get(unit, 0.0) if unit else 1.0)


def parse_numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """'1,2,3' as finite numbers."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise typer.BadParameter(f"{text!r}: expected {what}")
    return numbers


def parse_plane(text: str) -> "Pose":
    """'0,2,0:1,0,0:0,0,1': a point of the plane and the directions of its x and y."""
    parts = text.split(":")
    what = "ORIGIN:U:V, three numbers each, as in 0,2,0:1,0,0:0,0,1 for an upright plane"
    if len(parts) != 3:
        raise typer.BadParameter(f"{text!r}: expected {what}")
    from rfsg.scene.scene import SceneError
    from rfsg.tracer.cells import plane_through

    try:
        return plane_through(*(parse_numbers(part, 3, what) for part in parts))
    except SceneError as error:
        raise typer.BadParameter(f"{text!r}: {error}") from None


def parse_variants(texts: list[str]) -> dict[str, dict[str, str]]:
    """['/World/Door:state=open'] as {prim path: {variant set: choice}}."""
    variants: dict[str, dict[str, str]] = {}
    what = "PRIM:SET=NAME, as in /World/Door:state=open"
    for text in texts:
        path, colon, choice = text.partition(":")
        if not (path and colon):
            raise typer.BadParameter(f"{text!r}: expected {what}")
        name, value = parse_pair(choice, what)
        variants.setdefault(path.strip(), {})[name] = value
    return variants


def parse_pair(text: str, what: str) -> tuple[str, str]:
    """'A=B' as (A, B)."""
    left, equals, right = (part.strip() for part in text.partition("="))
    if not (left and equals and right):
        raise typer.BadParameter(f"{text!r}: expected {what}")
    return left, right


def parse_move(text: str) -> tuple[str, tuple[float, float, float], float]:
    """'/World/Cabinet=1.2,0,0,90' as path, metres and degrees; the last may be left out."""
    path, numbers = parse_pair(text, "PATH=x,y,z in metres, as in /World/Cabinet=1.2,0,0")
    return path, *_place(numbers, f"as in {path}=1.2,0,0 or, turned, {path}=1.2,0,0,90")


def parse_addition(text: str) -> tuple[str, str, tuple[float, float, float], float]:
    """'/World/Desk_2=desk.usda@1,2,0,90' as path, asset, metres and degrees."""
    what = "PATH=ASSET@x,y,z in metres, as in /World/Desk_2=desk.usda@1,2,0"
    path, rest = parse_pair(text, what)
    asset, at, numbers = rest.rpartition("@")
    if not (at and asset.strip()):
        raise typer.BadParameter(f"{text!r}: expected {what}")
    return path, asset.strip(), *_place(numbers, "as in desk.usda@1,2,0 or, turned, @1,2,0,90")


def _place(numbers: str, example: str) -> tuple[tuple[float, float, float], float]:
    """'1,2,0' or '1,2,0,90' as metres and degrees."""
    turned = numbers.count(",") == 3
    what = f"three numbers in metres, and degrees about z if wanted, {example}"
    x, y, z, *yaw = parse_numbers(numbers, 4 if turned else 3, what)
    return (x, y, z), yaw[0] if yaw else 0.0


def parse_quality(name: str, changes: list[str]) -> "Quality":
    """A preset with single fields changed ('depth=2')."""
    from rfsg.tracer.plan import Quality

    pairs = dict(parse_pair(change, "FIELD=VALUE, as in depth=2") for change in changes)
    try:
        kinds = {key: type(value) for key, value in vars(Quality.named(name)).items()}
        values = {key: kinds.get(key, str)(value) for key, value in pairs.items()}
        return Quality.named(name, **values)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
