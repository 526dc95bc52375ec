"""A library: a folder of assets with an index, ``index.json``, that says what is in it at a glance.

The index is a courtesy: it is written anew when a file has changed, and left out where the folder may
only be read. It decides nothing. What a library holds are the asset files that are in the folder; an
entry speaks for a file only while the file hashes to what the entry says, and an index that is damaged,
or too large, is as good as none.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from rfsg.scene import files
from rfsg.scene.assets import LoadedAsset, load_asset
from rfsg.scene.errors import SceneError
from rfsg.scene.usd.layers import asset_bytes
from rfsg.scene.weights import refuse_overwrite, write_beside

INDEX = "index.json"
INDEX_VERSION = 1
MAX_INDEX_BYTES = 8 * 2**20
MAX_ASSETS = 10_000
MAX_TEXT = 4096  # letters of one entry's text
MAX_PICTURE_BYTES = 16 * 2**20
ENDINGS = (".usda", ".usdc", ".usd", ".usdz")


@dataclass(frozen=True)
class Card:
    """What a library says of one asset. ``file``, ``picture``: relative to the folder; the picture of
    a package is PACKAGE[NAME]. shape, surface: kinds. size: sides of the surface that is drawn, else
    of the bounds [m]. bytes: of all its files. band: [Hz]. error: how exact it is, in words. sha256:
    of the weights; layer_sha256: of the USD file that this was read from."""

    name: str
    file: str
    shape: str
    surface: str
    size: tuple[float, float, float]
    bytes: int
    band: tuple[float, float] | None
    error: str
    sha256: str
    picture: str | None
    layer_sha256: str


class Library(Mapping[str, Path]):
    """The assets of a folder and of the folders in it: ``library["cabinet"]`` is the path of the USD
    file, as ``scene.replaced(path, library["desk"])`` takes it, and ``library.card("cabinet")`` what is
    known of it.

    An asset is called as its file is; where two are called alike, also as its folder is ("old/desk").
    ``faults``: files that are no assets in order, and why, one line each.

    Raises SceneError for a folder that is not there or holds too many files.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        found = _layers(self.folder)
        known = _index(self.folder)
        cards: dict[str, Card] = {}
        faults: list[str] = []
        for name, path in _named(self.folder, found).items():
            file, digest = path.relative_to(self.folder).as_posix(), _sha256(path)
            card = known.get((file, digest))
            if card is None or card.name != name:
                try:
                    card = _card(self.folder, name, path, digest)
                except SceneError as error:
                    faults += error.faults
                    continue
            cards[name] = card
        self.faults = tuple(faults)
        self._cards = cards
        if {(c.file, c.layer_sha256): c for c in cards.values()} != known:
            self._write()

    def __getitem__(self, name: str) -> Path:
        return self.folder / self.card(name).file

    def __iter__(self) -> Iterator[str]:
        return iter(self._cards)

    def __len__(self) -> int:
        return len(self._cards)

    @property
    def cards(self) -> tuple[Card, ...]:
        """What is known of each asset, by name."""
        return tuple(self._cards.values())

    def card(self, name: str) -> Card:
        """What is known of an asset. Raises KeyError naming what is there instead."""
        if name not in self._cards:
            there = ", ".join(self._cards) or "no assets"
            raise KeyError(f"{name}: not in {self.folder}, which holds {there}")
        return self._cards[name]

    def picture(self, name: str) -> bytes | None:
        """The picture's bytes, None where there is none in the library's folder."""
        card = self.card(name)
        path = str(self.folder / card.picture) if card.picture else ""
        if not path or files.outside(path, [self.folder]):
            return None
        try:
            return asset_bytes(path, f"{path}: the picture's bytes", MAX_PICTURE_BYTES)
        except SceneError:
            return None

    def add(self, asset: str | Path, *, overwrite: bool = False) -> "Library":
        """The library with a copy of an asset's files, in a folder NAME/.

        Raises SceneError for an asset that is not in order or whose files lie in several folders, and
        for files that are there unless ``overwrite``."""
        loaded = load_asset(asset)
        if not loaded.parts:
            raise SceneError(
                [f"{asset}: its files lie in several folders, or one is missing, so a copy would be "
                 f"torn; write it whole first: rfsg export {asset} {loaded.prim} -o {loaded.path.stem}/"]
            )  # fmt: skip
        home, origin = self.folder / loaded.path.stem, loaded.parts[0].parent
        copies = {home / part.relative_to(origin): part for part in reversed(loaded.parts)}
        refuse_overwrite(list(copies), overwrite)
        for copy, part in copies.items():  # the layer last
            copy.parent.mkdir(parents=True, exist_ok=True)
            if not (copy.exists() and os.path.samefile(copy, part)):
                write_beside(copy, part.read_bytes(), overwrite)
        return Library(self.folder)

    def _write(self) -> None:
        told = {"formatVersion": INDEX_VERSION, "assets": [asdict(c) for c in self.cards]}
        try:
            data = json.dumps(told, indent=1, allow_nan=False).encode() + b"\n"
            write_beside(self.folder / INDEX, data, True)
        except OSError:
            return  # a folder that may only be read: the next reader reads the assets again


def error_of(provenance: Mapping[str, Any]) -> str:
    """How exact an asset is, in words, from what was told when it was trained; empty if nothing was."""
    words = []
    report, held = provenance.get("report"), provenance.get("validation")
    if isinstance(report, Mapping) and _number(report.get("surface_mean_mm")):
        words.append(f"surface {report['surface_mean_mm']:.2g} mm (mean)")
    held = held if isinstance(held, Mapping) and held.get("readings") else provenance.get("train")
    if isinstance(held, Mapping) and _number(held.get("median_db")):
        words.append(
            f"power {held['median_db']:.2g} dB (median of {held.get('readings')} readings)"
        )
    return ", ".join(words)


# what is there


def _layers(folder: Path) -> list[Path]:
    """USD files in a folder and in the folders in it, none of them hidden or a link out of it."""
    if not folder.is_dir():
        raise SceneError([f"{folder}: no such folder; a library is a folder of assets"])
    found: list[Path] = []
    for pattern in ("*", "*/*"):
        for path in folder.glob(pattern):
            hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
            if path.suffix not in ENDINGS or hidden or not path.is_file():
                continue
            if files.outside(str(path), [folder]) is None:
                found.append(path)
            if len(found) > MAX_ASSETS:
                raise SceneError(
                    [f"{folder}: more than {MAX_ASSETS} USD files; name a smaller folder"]
                )
    return sorted(found)


def _named(folder: Path, found: list[Path]) -> dict[str, Path]:
    stems = [path.stem for path in found]
    whole = [path.relative_to(folder).with_suffix("").as_posix() for path in found]
    names = [s if stems.count(s) == 1 else w for s, w in zip(stems, whole, strict=True)]
    names = [
        n if names.count(n) == 1 else path.relative_to(folder).as_posix()
        for n, path in zip(names, found, strict=True)
    ]
    return dict(sorted(zip(names, found, strict=True)))


def _sha256(path: Path) -> str:
    """Of a file; of one too large to be a layer that is read, its name and size will do."""
    if path.stat().st_size > files.MAX_LAYER_BYTES:
        return f"{path.name} {path.stat().st_size}"
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _card(folder: Path, name: str, path: Path, digest: str) -> Card:
    loaded = load_asset(path)
    drawn = loaded.extent
    low, high = loaded.body.shape.bounds().tolist() if drawn is None else drawn.tolist()
    return Card(
        name,
        path.relative_to(folder).as_posix(),
        loaded.body.shape.kind,
        loaded.body.surface.kind,
        (round(high[0] - low[0], 4), round(high[1] - low[1], 4), round(high[2] - low[2], 4)),
        sum(part.stat().st_size for part in loaded.parts or (path,)),
        loaded.body.band,
        error_of(loaded.provenance)[:MAX_TEXT],
        loaded.sha256,
        _inside(folder, loaded),
        digest,
    )


def _inside(folder: Path, loaded: LoadedAsset) -> str | None:
    """The picture's path relative to the library; None for none, and for one outside."""
    if loaded.picture is None or files.outside(loaded.picture, [folder]):
        return None
    return Path(os.path.relpath(loaded.picture, os.path.realpath(folder))).as_posix()


# the index, which nobody trusts


def _index(folder: Path) -> dict[tuple[str, str], Card]:
    """The entries of the index that are in order, by file and by what the file must hash to."""
    path = folder / INDEX
    try:
        if path.stat().st_size > MAX_INDEX_BYTES:
            return {}
        told = json.loads(path.read_bytes())
        rows = told["assets"] if told["formatVersion"] == INDEX_VERSION else []
        cards = [_read_card(row) for row in rows[:MAX_ASSETS]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return {(card.file, card.layer_sha256): card for card in cards}


def _read_card(row: Any) -> Card:
    """A card as an index says it. Raises ValueError or TypeError for one that is not in order."""
    if not isinstance(row, dict) or row.keys() != {f.name for f in fields(Card)}:
        raise ValueError("an entry with other fields")
    texts = [
        row[n] for n in ("name", "file", "shape", "surface", "error", "sha256", "layer_sha256")
    ]
    texts += [] if row["picture"] is None else [row["picture"]]
    if not all(isinstance(t, str) and len(t) <= MAX_TEXT for t in texts):
        raise ValueError("text that is none, or too long")
    band = row["band"]
    numbers = [*row["size"], row["bytes"], *(band or ())]
    if not all(_number(n) for n in numbers) or len(row["size"]) != 3 or len(band or (1, 1)) != 2:
        raise ValueError("numbers that are none")
    size = tuple(float(n) for n in row["size"])
    held = None if band is None else (float(band[0]), float(band[1]))
    return Card(**(row | {"size": size, "band": held, "bytes": int(row["bytes"])}))


def _number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) < 1e18 and math.isfinite(value)
